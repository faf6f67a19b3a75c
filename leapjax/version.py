"""The version of the library."""

from importlib import metadata


def find_version() -> str:
    """The version that was installed; "0+unknown" in a checkout that was not."""
    try:
        return metadata.version("leapjax")
    except metadata.PackageNotFoundError:
        return "0+unknown"


__version__ = find_version()
