"""Brings the tables and plots of bench/results into the pages; in the repository they are linked where they lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

BENCH = Path(__file__).parents[1] / "bench"


def on_files(files: Files, config: Any) -> Files:
    """Add what the benchmarks wrote as pages and pictures of their own."""
    for path in sorted((BENCH / "results").iterdir()):
        if path.suffix in (".md", ".png"):
            name = path.relative_to(BENCH).as_posix()
            files.append(File(name, str(BENCH), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to them, as the pages have them."""
    return markdown.replace("](../bench/results/", "](results/")
