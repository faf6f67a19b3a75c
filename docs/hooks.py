"""The site's first page is the README; links to what is no part of the site become text."""

import os
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

LINK = r"\[([^\]]+)\]\(([^)#\s]+)(#[^)]*)?\)"


def on_files(files: Files, config: Any) -> Files:
    """Adds the first page."""
    readme = Path(config.config_file_path).parent / "README.md"
    text = readme.read_text(encoding="utf-8").replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Mends the links of a page. What is nowhere at all stays, and the build fails of it."""
    root, here = Path(config.config_file_path).parent, Path(page.file.src_uri).parent
    before = root if page.file.src_uri == "index.md" else Path(config.docs_dir) / here

    def mended(found: re.Match) -> str:
        text, target, anchor = found.group(1), found.group(2), found.group(3) or ""
        if target == "../README.md":
            return f"[{text}](index.md{anchor})"
        beside = os.path.normpath(here / target)
        elsewhere = files.get_file_from_path(beside) is None and (before / target).exists()
        return text if elsewhere else found.group()

    return re.sub(LINK, mended, markdown)


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Refuses a page that shows the name of a file instead of what is in it."""
    del config, files
    if re.search(r"8\s*&lt;", re.sub("<[^>]*>", "", html)):  # highlighting has put tags between
        raise PluginError(f'{page.file.src_uri}: --8<-- "FILE" was not followed')
    return html
