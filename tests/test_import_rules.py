"""Who may import whom: the plan of the house, checked on the source so that it cannot rot."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "dpmjax"

EVERYBODY_MAY = {"types", "checks", "sequences", "reading", "progress", "kept_programs"}
ALLOWED: dict[str, set[str]] = {
    "types": set(),
    "checks": {"compile_cache"},
    "sequences": set(),
    "reading": set(),
    "progress": set(),
    "checkpoints": set(),
    "compile_cache": set(),
    "kept_programs": {"compile_cache"},
    "geometry": set(),
    "scan": {"geometry", "pose_graph"},
    "nets": {"geometry"},
    "losses": {"geometry"},
    "pose_graph": {"geometry"},
    "deepmapping": {"geometry", "nets", "losses", "scan"},
    "deeppointmap": {"geometry", "nets", "losses", "scan", "metrics"},
    "slam": {"deeppointmap", "pose_graph", "geometry", "scan"},
    "registration": {"deeppointmap", "scan", "slam"},
    "saved_maps": {"slam", "deeppointmap", "scan", "geometry", "weights", "io"},
    "metrics": {"geometry"},
    "io": {"geometry", "pose_graph"},
    "simulation": {"geometry"},
    "viz": {"geometry"},
    "weights": {"geometry", "nets", "deeppointmap"},
}
# This file joins the map of planar scans with DeepMapping.
ALLOWED_IN_FILE: dict[str, set[str]] = {"slam/planar/pipeline.py": {"deepmapping"}}
# The command imports every room, and no room imports it.
ALLOWED |= {"cli": set(ALLOWED) - EVERYBODY_MAY, "__main__": {"cli"}}
ONLY_IN: dict[str, set[str]] = {"matplotlib": {"viz", "io"}, "jaxlie": {"geometry"}, "torch": {"weights"}}
NEVER = {"experiments", "benchmarks", "tests"}

MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def imported_names(path: Path) -> set[str]:
    """Full dotted names of everything that a module imports, also inside functions and under TYPE_CHECKING."""
    own_package = ["dpmjax", *path.relative_to(PACKAGE).parent.parts] if path.is_relative_to(PACKAGE) else []
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = own_package[: len(own_package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            names.update(f"{stem}.{alias.name}" for alias in node.names)
    return names


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_imports_only_what_its_room_may(path: Path) -> None:
    room = room_of(path)
    assert room in ALLOWED, f"{room}: a new room needs a line in the plan (CONTRIBUTING.md) and in this test"
    for name in imported_names(path):
        top, *rest = name.split(".")
        assert top not in NEVER, f"{path.name} imports {name}"
        assert room in ONLY_IN.get(top, {room}), f"{path.name} imports {name}, which only {ONLY_IN[top]} may"
        if top == "dpmjax":
            assert rest, f"{path.name} imports the whole package; import from the room"
            may = ALLOWED[room] | EVERYBODY_MAY | {room} | ALLOWED_IN_FILE.get(str(path.relative_to(PACKAGE)), set())
            assert rest[0] in may, f"{path.name}: {room} may not import {rest[0]}"


@pytest.fixture(scope="module")
def imported_rooms() -> dict[str, set[str]]:
    rooms: dict[str, set[str]] = {room_of(path): set() for path in MODULES}
    for path in MODULES:
        names = (name.split(".") for name in imported_names(path))
        rooms[room_of(path)] |= {name[1] for name in names if name[0] == "dpmjax"} - {room_of(path)}
    return rooms


def reached(room: str, imported: dict[str, set[str]]) -> set[str]:
    found: set[str] = set()
    new = imported[room]
    while new:
        found |= new
        new = set().union(*(imported[other] for other in new)) - found
    return found


def test_no_room_reaches_itself(imported_rooms) -> None:
    assert len(imported_rooms) > 15
    assert "geometry" in reached("weights", imported_rooms)
    assert not [room for room in imported_rooms if room in reached(room, imported_rooms)]


@pytest.mark.parametrize("folder", [PACKAGE / "cli", ROOT / "experiments"], ids=lambda path: path.name)
def test_no_circle_of_modules_within(folder: Path) -> None:
    base = PACKAGE.parent if folder.is_relative_to(PACKAGE) else ROOT
    paths = {".".join(path.relative_to(base).with_suffix("").parts): path for path in folder.rglob("*.py")}
    imported = {
        module: {other for name in imported_names(path) for other in paths if f"{name}.".startswith(f"{other}.")}
        for module, path in paths.items()
    }
    assert sum(map(len, imported.values())) > 3
    assert not [module for module in imported if module in reached(module, imported)]


def test_nets_and_losses_never_meet(imported_rooms) -> None:
    assert "losses" not in reached("nets", imported_rooms)
    assert "nets" not in reached("losses", imported_rooms)


def test_no_algorithm_reaches_files_simulators_or_pictures(imported_rooms) -> None:
    edges = {"io", "saved_maps", "simulation", "viz"}
    for room in imported_rooms.keys() - edges - {"cli", "__main__"}:
        assert not reached(room, imported_rooms) & edges, room


def test_package_door_imports_only_the_lazy_loader() -> None:
    assert {name.split(".")[0] for name in imported_names(PACKAGE / "__init__.py")} == {"lazy_loader"}


def listed_names() -> set[str]:
    """Full names of everything that the door of the package or of a room lists."""
    found = set()
    for stub in PACKAGE.rglob("__init__.pyi"):
        room = ".".join(["dpmjax", *stub.parent.relative_to(PACKAGE).parts])
        found |= {f"{room}.{name}" for name in re.findall(r"import \w+ as (\w+)", stub.read_text(encoding="utf-8"))}
    return found | {f"dpmjax.{room}" for room in ALLOWED}


OUTSIDE = sorted(path for folder in ("experiments", "examples", "benchmarks") for path in (ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_is_outside_the_package_uses_its_doors(path: Path) -> None:
    names = {name for name in imported_names(path) if name.startswith("dpmjax.")}
    assert not sorted(names - listed_names())
