"""Pages of the site that are made from other files, and links that leave the site.

index.md is README.md, reference.md has the docstring of each name of api.md, and examples.md has the examples and
their output. Each guide ends with the output of its linked examples. Links to files outside docs/ lead to the
repository if its address is known.
"""

from __future__ import annotations

import posixpath
import re
import runpy
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
MADE = runpy.run_path(str(ROOT / "docs" / "run_examples.py"))


def on_files(files: Files, config: Any) -> Files:
    """Adds the pages that are made here."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    for name, text in {"index.md": readme, "reference.md": reference(), "examples.md": examples()}.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Leads links out of the site to the repository, or makes code of them where its address is unknown."""

    def outside(match: re.Match[str]) -> str:
        text, target = match.groups()
        folder = "" if page.file.src_uri == "index.md" else posixpath.join("docs", posixpath.dirname(page.file.src_uri))
        path, _, anchor = target.partition("#")
        path = posixpath.normpath(posixpath.join(folder, path))
        if target.startswith(("http", "#", "mailto:")) or path.startswith("docs/") or files.get_file_from_path(path):
            return match.group()
        if path == "README.md":
            return f"[{text}](index.md#{anchor})"
        return f"[{text}]({config.repo_url.rstrip('/')}/blob/main/{path})" if config.repo_url else text

    linked = sorted(set(re.findall(r"\(\S*examples/(\d\d_\w+)\.py\)", markdown)))
    shown = [printed(name) for name in linked if page.file.src_uri.startswith("guides/")]
    return "\n\n".join([re.sub(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)", outside, markdown), *shown])


def reference() -> str:
    """Returns the page of the public names: those of api.md with signature and docstring."""
    text, entries = (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), []
    for line in text.partition("\n## ")[2].splitlines():
        names = re.findall(r"`(\w+)`", line.partition(": ")[0]) if line.startswith("* `") else []
        entries.append("## " + line if not entries else line if line.startswith("## ") else "")
        entries += [f"::: dpmjax.{name}\n" for name in names]
    return "# Public names\n\n" + re.sub(r"\n{3,}", "\n\n", "\n".join(entries))


def examples() -> str:
    """Returns the page of the examples: code and output of each."""
    parts = ["# Examples\n\nEach is a file in `examples/`, which the tests run.\n"]
    for path in MADE["EXAMPLES"]:
        title = path.stem[3:].replace("_", " ").capitalize()
        parts.append(f"## {title}\n\n```python\n{path.read_text(encoding='utf-8')}```\n\n{printed(path.stem)}")
    return "\n".join(parts)


def printed(name: str) -> str:
    """Returns the recorded output of an example."""
    return f"`examples/{name}.py` prints:\n\n```\n{MADE['outputs']()[name + '.py']['output']}```\n"
