"""The page of a run, `report.html`: one file that needs no network, with a view of 3-D maps that can be turned."""

from __future__ import annotations

import base64
import importlib.util
import json
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from dpmjax.io.clouds import parse_ply

Layer = tuple[np.ndarray, dict[str, Any]]
ReadTable = Callable[[str], list[dict[str, str]]]

# More points make a page of more than 10 MB, half of which is plotly; longer tables are in the files.
_MAX_POINTS, _MAX_ROWS = 200_000, 200
_CLOUDS, _DECISIONS = ("map.ply", "aligned.ply"), ("loops.csv", "localizations.csv", "scans.csv")
_UNREMARKABLE = {"tracked", "first", "found"}
_HEAD = """<!doctype html><meta charset="utf-8"><title>{0}</title><style>body {{font: 15px sans-serif; margin: 2em auto;
max-width: 70em}} td, th {{padding: .1em .8em .1em 0; text-align: left; vertical-align: top}} img {{max-width: 100%}}
table {{display: block; overflow-x: auto}}
.verdict {{font-size: 1.3em}}</style><h1>{0}</h1>"""


def write_report(folder: Path, read_table: ReadTable) -> Path:
    """Writes the page of a finished run from its files: verdict, map, pictures, decisions, numbers.

    Args:
        folder: folder of the run, with `metrics.json`.
        read_table: called with the name of a table in the folder; returns its rows, none if there is no table.

    Returns:
        The page.
    """
    numbers = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    parts = [_HEAD.format(escape(folder.resolve().name)), f"<p>status: {escape(str(numbers['status']))}</p>"]
    if "verdict" in numbers:
        parts.append(f'<p class="verdict">{escape(str(numbers["verdict"]))}</p>')
    parts += [_map_view(folder, path, read_table) for path in map(folder.joinpath, _CLOUDS) if path.exists()]
    for picture in sorted(folder.glob("*.png")):
        code = base64.b64encode(picture.read_bytes()).decode()
        parts.append(f'<h2>{escape(picture.stem)}</h2><img alt="{picture.name}" src="data:image/png;base64,{code}">')
    for name in _DECISIONS:
        rows = [row for row in read_table(name) if name != "scans.csv" or row["status"] not in _UNREMARKABLE]
        if rows:
            shown = "" if len(rows) <= _MAX_ROWS else f", the first {_MAX_ROWS} of {len(rows)}"
            parts.append(f"<h2>{name}{shown}</h2>{_table(rows[0], (row.values() for row in rows[:_MAX_ROWS]))}")
    parts.append(f"<h2>Numbers</h2>{_table(('name', 'value'), _flat(numbers))}")
    page = folder / "report.html"
    page.write_text("\n".join(parts), encoding="utf-8", errors="surrogateescape")
    return page


def _map_view(folder: Path, cloud: Path, read_table: ReadTable) -> str:
    """Returns points, path and loops as a view in space; the pose and the status of a scan stand under the pointer."""
    if importlib.util.find_spec("plotly") is None:
        return "<p>A view of the map to turn: pip install 'dpmjax[report]', and run the command again.</p>"
    from plotly import graph_objects

    points = parse_ply(cloud.read_bytes(), str(cloud)).points.astype(np.float32)
    points = points[np.random.default_rng(0).permutation(len(points))[:_MAX_POINTS]]
    low, high = np.percentile(points[:, 2], (1, 99)) if len(points) else (0.0, 1.0)
    shades = np.clip(255 * (points[:, 2] - low) / max(high - low, 1e-6), 0, 255).astype(np.uint8)
    marker = {"size": 1, "color": shades, "colorscale": "Viridis", "opacity": 0.4}
    layers: list[Layer] = [(points, {"marker": marker, "name": "map", "mode": "markers", "hoverinfo": "skip"})]
    layers += _path_and_loops(folder, read_table)
    camera = {"eye": {"x": 0.3, "y": -1.6, "z": 2.0}}
    layout = {"scene": {"aspectmode": "data", "camera": camera}, "height": 700, "margin": dict.fromkeys("lrtb", 0)}
    figure = graph_objects.Figure(layout=layout | {"legend": {"x": 0, "itemsizing": "constant"}})
    for each, style in layers:
        figure.add_scatter3d(x=each[:, 0], y=each[:, 1], z=each[:, 2], **style)
    return str(figure.to_html(full_html=False, include_plotlyjs=True))


def _path_and_loops(folder: Path, read_table: ReadTable) -> list[Layer]:
    if not (folder / "trajectory.npy").exists():
        return []
    path, scans = np.load(folder / "trajectory.npy")[:, :3, 3], read_table("scans.csv")
    text = [f"scan {scan['scan']}: {scan['status']}; {scan['reason']}" for scan in scans]
    row_of = {scan["scan"]: row for row, scan in enumerate(scans)}
    lines = np.zeros((0, 3))
    for loop in read_table("loops.csv"):
        ends = [row_of.get(loop["scan"]), row_of.get(loop["other_scan"])]
        if loop["status"] == "accepted" and None not in ends:  # a line ends at a point that is no number
            lines = np.concatenate([lines, path[np.array(ends, int)], np.full((1, 3), np.nan)])
    drawn = {"line": {"color": "blue", "width": 5}, "marker": {"size": 2}}
    joined = {"mode": "lines", "line": {"color": "green", "width": 5}}
    return [(path, {"name": "path", "text": text, **drawn}), (lines, {"name": "loops", **joined})]


def _flat(numbers: dict[str, Any], above: str = "") -> list[Sequence[object]]:
    """Returns a row for each number, those of tables within named by both."""
    rows: list[Sequence[object]] = []
    for name, value in numbers.items():
        shown = f"{value:.6g}" if isinstance(value, float) else value
        rows += _flat(value, f"{above}{name}.") if isinstance(value, dict) else [(above + name, shown)]
    return rows


def _table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    cells = ("".join(f"<td>{escape(str(value))}</td>" for value in row) for row in rows)
    return f"<table><tr>{''.join(f'<th>{name}</th>' for name in head)}</tr><tr>{'</tr><tr>'.join(cells)}</tr></table>"
