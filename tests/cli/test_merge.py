"""The command `dpmjax merge` on a network that compiles in seconds."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_OK, load_json
from dpmjax.slam import MergedMaps, take_keyframes
from dpmjax.slam.keyframe_map import MapEdge
from dpmjax.slam.loops import Loop
from tests.deeppointmap import toy
from tests.experiments.running import read_rows


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("case")
    model = dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL)
    dpmjax.save_model(model, folder / "model.safetensors")
    dpmjax.save_model(dpmjax.init_model(jax.random.key(1), toy.SLAM_MODEL), folder / "other.safetensors")
    for seed, name in ((1, "a"), (2, "b"), (3, "c")):
        drive = toy.drive(seed, num_scans=4, step_m=1.9)
        result = dpmjax.run_slam(model, [drive.read_scan(number) for number in range(4)])
        dpmjax.save_map(folder / f"{name}.npz", result.map)
    return folder


def run(*arguments) -> int:
    return main(["merge", *map(str, arguments)])


def joined_by_a_loop(model, *maps, on_keyframe=None) -> MergedMaps:
    """The first two maps meet at their first keyframes; a third one meets nobody."""
    starts = np.cumsum([0, *map(len, maps)])
    everything = dpmjax.merge_maps(model, *maps).slam_map
    loop = Loop(int(starts[1]), 0, "retrieval", "accepted", 0.9, 0.95, 0.03, np.eye(4), np.eye(6))
    rejected = loop._replace(source=int(starts[1]) + 1, status="improbable", T_target_source=None, information=None)
    edge = MapEdge(loop.source, loop.target, np.eye(4), np.eye(6), "loop")
    everything = replace(everything, edges=(*everything.edges, edge))
    component = (0, 0, *range(1, len(maps) - 1))
    parts = (take_keyframes(everything, range(starts[2])), *maps[2:])
    map_of_keyframe = np.repeat(np.arange(len(maps)), [len(each) for each in maps])
    return MergedMaps(parts, component, (loop, rejected), everything, map_of_keyframe)


def test_maps_that_meet_become_one_file(case, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("dpmjax.slam.merge_maps", joined_by_a_loop)
    out, weights = tmp_path / "out", ("--weights", case / "model.safetensors")
    assert run(case / "a.npz", case / "b.npz", *weights, "-o", out) == EXIT_OK
    assert "one map now" in capsys.readouterr().out
    metrics = load_json(out / "metrics.json")
    a, b, both = (dpmjax.load_map(path) for path in (case / "a.npz", case / "b.npz", out / "map.npz"))
    assert len(both) == len(a) + len(b) == metrics["num_keyframes"]
    counts = {"num_keyframes": len(both), "num_measured_parts": 1}
    assert metrics["parts"] == [{"file": "map.npz", "maps": [1, 2], **counts}]
    assert metrics["status"] == "done"
    rows = read_rows(out, "loops.csv")
    assert [row["map"] + row["other_map"] + row["status"] for row in rows] == ["21accepted", "21improbable"]
    # Scans are numbered as in the drive of each map.
    assert [row["scan"] for row in rows] == [str(keyframe.scan) for keyframe in b.keyframes[:2]]
    assert len(dpmjax.read_g2o(out / "graph.g2o").poses) == len(both)
    assert (out / "map.png").stat().st_size > 0


@pytest.mark.slow
def test_guessed_motions_within_a_map_are_told(case, tmp_path, monkeypatch, capsys) -> None:
    """The second half of the second map has a guessed pose beside the first half, and so beside the first map."""
    a, b = (dpmjax.load_map(case / f"{name}.npz") for name in "ab")
    half = len(b) // 2
    edges = [edge._replace(kind="guess") if edge.target < half <= edge.source else edge for edge in b.edges]
    dpmjax.save_map(tmp_path / "guessed.npz", replace(b, edges=tuple(edges)))
    monkeypatch.setattr("dpmjax.slam.merge_maps", joined_by_a_loop)
    weights = ("--weights", case / "model.safetensors")
    assert run(case / "a.npz", tmp_path / "guessed.npz", *weights, "-o", tmp_path / "out") == EXIT_OK
    assert "one map now, in 2 parts whose relative poses are guesses" in capsys.readouterr().out
    metrics = load_json(tmp_path / "out" / "metrics.json")
    assert (metrics["status"], metrics["parts"][0]["num_measured_parts"]) == ("uncertain", 2)
    assert not MergedMaps((dpmjax.load_map(tmp_path / "out" / "map.npz"),), (), (), None, None).is_joined
    assert MergedMaps((a,), (), (), None, None).is_joined


@pytest.mark.slow
def test_maps_that_do_not_meet_stay_as_they_were(case, tmp_path, capsys) -> None:
    out, weights = tmp_path / "out", ("--weights", case / "model.safetensors")
    maps = [case / f"{name}.npz" for name in "abc"]
    assert run(*maps, *weights, "-o", out) == EXIT_OK
    metrics = load_json(out / "metrics.json")
    assert (metrics["num_maps"], metrics["num_parts"], metrics["num_loops"]) == (3, 3, 0)
    assert not (out / "map.npz").exists()
    for number, path in enumerate(maps, start=1):
        before, after = dpmjax.load_map(path), dpmjax.load_map(out / f"map_{number}.npz")
        np.testing.assert_array_equal(after.T_world_keyframe, before.T_world_keyframe)
    assert capsys.readouterr().out.count("no common place with another map") == 3
    # An earlier run is replaced on request only.
    assert run(*maps, *weights, "-o", out) == EXIT_BAD_INPUT
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("maps", "weights", "message"),
    [
        (("a.npz", "b.npz", "a.npz"), "model.safetensors", "a.npz is given twice"),
        (("a.npz", "none.npz"), "model.safetensors", "none.npz: no such file"),
        (("a.npz", "model.safetensors"), "model.safetensors", "model.safetensors"),
        (("a.npz", "b.npz"), "none.safetensors", "none.safetensors"),
        (("a.npz", "b.npz"), "other.safetensors", "name the weights that made it with --weights"),
    ],
)
def test_bad_input_is_told_in_one_line(case, refused, maps, weights, message) -> None:
    assert message in refused("merge", *(case / name for name in maps), "--weights", case / weights)
