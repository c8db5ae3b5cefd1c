"""The command `dpmjax graph`: files of g2o and TORO are optimised, or refused in one line."""

from pathlib import Path

import numpy as np
import pytest

import dpmjax
from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_FAILED, EXIT_OK, load_json
from tests.io.test_g2o import EDGES, PLANAR, spatial_text

LOOP = "".join(f"EDGE_SE2 {i} {(i + 1) % 4} 1 0 1.57 4 0 0 4 0 9\n" for i in range(4))


def run(*options: object) -> int:
    return main(["graph", *map(str, options)])


@pytest.mark.parametrize("text", [PLANAR, EDGES, LOOP, spatial_text()[0]], ids=["plane", "edges", "loop", "space"])
def test_graphs_are_optimised(tmp_path: Path, text: str, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "a.g2o").write_text(text)
    assert run(tmp_path / "a.g2o", "-o", tmp_path / "out") == EXIT_OK
    metrics = load_json(tmp_path / "out" / "metrics.json")
    found = dpmjax.optimize_pose_graph(dpmjax.read_g2o(tmp_path / "a.g2o"))
    assert metrics["chi2"] == pytest.approx(found.chi2, abs=1e-12)
    assert metrics["status"] == "done"
    np.testing.assert_allclose(dpmjax.read_g2o(tmp_path / "out" / "graph.g2o").poses, found.graph.poses, atol=1e-12)
    assert len(np.loadtxt(tmp_path / "out" / "trajectory_tum.txt")) == len(found.graph.poses)
    assert (tmp_path / "out" / "trajectory.png").is_file()
    assert "chi2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (LOOP, None),
        (EDGES, "no edge measures x, y, heading of nodes 20, 21"),
        (PLANAR + "VERTEX_SE2 9 5 5 0\n", "no edge measures x, y, heading of node 9"),
        (LOOP.replace("4 0 0 4 0 9", "0 0 0 0 0 0"), "x, y, heading of node 1; x, y, heading of node 2; x, y"),
        (PLANAR + "VERTEX_SE2 9 5 5 0\nEDGE_SE2 3 9 1 1 0 1 0 0 1 0 0\n", "no edge measures heading of node 9"),
    ],
    ids=["one part", "two parts", "a node without edges", "no information", "no heading"],
)
def test_nodes_that_the_edges_leave_free_are_named(tmp_path: Path, text: str, note: str | None) -> None:
    (tmp_path / "a.g2o").write_text(text)
    assert run(tmp_path / "a.g2o", "-o", tmp_path / "out") == EXIT_OK
    found = load_json(tmp_path / "out" / "metrics.json")["input_notes"]
    assert (note is None) == (not found)
    assert note is None or note in found[0]


def test_indefinite_information_is_refused_or_projected(tmp_path: Path, refused) -> None:
    (tmp_path / "a.g2o").write_text(PLANAR + "EDGE_SE2 3 7 -1 -2 -0.5 1 2 0 1 0 1\n")
    line = refused("graph", tmp_path / "a.g2o")
    assert "a.g2o: line 7: the information of edge 3 7" in line
    assert "--nearest-psd" in line
    assert run(tmp_path / "a.g2o", "--nearest-psd", "-o", tmp_path / "out") == EXIT_OK


def test_no_minimum_is_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    rng = np.random.default_rng(0)
    ends = [(a, b) for a in range(9) for b in range(a)]
    rows = [f"EDGE_SE2 {a} {b} {rng.normal()} {rng.normal()} {rng.uniform(-3, 3)} 1 0 0 1 0 1" for a, b in ends]
    (tmp_path / "a.g2o").write_text("\n".join(rows))
    assert run(tmp_path / "a.g2o", "--iterations", 1, "-o", tmp_path / "out") == EXIT_FAILED
    assert "no minimum after 1 iterations" in capsys.readouterr().err.splitlines()[-1]
    assert load_json(tmp_path / "out" / "metrics.json")["status"] == "failed"
