"""The pages say what is true of the tree: the plan of the rooms, and the files that they name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.test_import_rules import ALLOWED, EVERYBODY_MAY

ROOT = Path(__file__).parents[1]
FILES = {path.relative_to(ROOT).as_posix() for top in ("src", "experiments") for path in (ROOT / top).rglob("*")}


def test_contributing_tells_who_may_import_whom() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|[^|]*\|([^|]*)\|$", text, re.MULTILINE)
    assert {room: set(re.findall(r"`(\w+)`", may)) for room, may in rows} == {
        room: may for room, may in ALLOWED.items() if room not in EVERYBODY_MAY
    }
    assert all(f"`{room}`" in text for room in EVERYBODY_MAY)


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "README.md", "docs/methods.md", "docs/notebook/deepmapping_notes.md"])
def test_files_that_a_page_names_exist(page) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w/*]+(?:\.py|/))`", text))
    assert named or page != "CONTRIBUTING.md"
    for name in named - {"slam/"}:
        pattern = re.compile(f"(.*/)?{re.escape(name.rstrip('/')).replace(re.escape('*'), '[^/]*')}")
        assert any(map(pattern.fullmatch, FILES)) or (ROOT / name).exists(), f"{page} names {name}"


def test_result_files_name_no_path_of_a_machine() -> None:
    files = sorted((ROOT / "docs" / "results").glob("*.json"))
    assert files
    for path in files:
        found = re.search(r'"(?:/[\w.-]+){2,}|"[A-Z]:\\', path.read_text(encoding="utf-8"))
        assert found is None, f"{path.name}: {found}"
