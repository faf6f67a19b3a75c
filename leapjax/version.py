"""The version of the library."""

from importlib import metadata


def find_version() -> str:
    """Returns the installed version; "0+unknown" in a checkout that is not installed."""
    try:
        return metadata.version("leapjax")
    except metadata.PackageNotFoundError:
        return "0+unknown"


__version__ = find_version()
