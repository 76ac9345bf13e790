# SPDX-License-Identifier: Apache-2.0
"""Hooks of mkdocs.yml: README.md is the first page, and links to code become its path."""

import re
from pathlib import Path

README = Path(__file__).resolve().parents[2] / "README.md"


def on_files(files, config):
    """Add README.md as index.md; its links begin at the repository."""
    from mkdocs.structure.files import File

    text = re.sub(r"\]\((?!docs/|https?:|#)", "](../", README.read_text(encoding="utf-8")).replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_markdown(markdown, **_):
    """Links out of docs/ have no page."""
    markdown = markdown.replace("](../README.md", "](index.md")
    return re.sub(r"\[([^\]]*)\]\(\.\./([^)]+)\)", r"\1 (`\2`)", markdown)
