"""Laws of the journal: a run that is cut off anywhere goes on as if it had never stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.geometry.host_tree import HostTree
from dpmjax.slam import (
    Journal,
    SlamConfig,
    SlamMethods,
    finish_slam,
    init_slam,
    make_methods,
    read_journal,
    step_slam,
)
from dpmjax.slam.columns import from_columns, to_columns
from tests.deeppointmap import toy
from tests.slam.test_odometry import motion, planes, seen_from
from tests.slam.truth import EMPTY, TruthGeometry, TruthMatcher, laps, scans_of

CONFIG = SlamConfig()


def recorded(methods: SlamMethods, scans: list, path: Path, content=None) -> tuple:
    """Runs on from what the journal holds, and appends a record a keyframe."""
    journal = Journal(path, content)
    state = content.state if content else init_slam()
    reports, fresh = list(content.reports) if content else [], []
    for scan in scans[len(reports) :]:
        state, report = step_slam(methods, state, scan)
        reports.append(report)
        fresh.append(report)
        if report.is_keyframe:
            journal.append(methods, state, fresh)
            fresh = []
    journal.close()
    return state, reports


def assert_same(found: object, expected: object) -> None:
    """All fields are the same, bit for bit and of the same kind."""
    if isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == expected.dtype
    elif isinstance(expected, tuple):
        assert len(found) == len(expected)
        for a, b in zip(found, expected, strict=True):
            assert_same(a, b)
    elif isinstance(expected, HostTree):
        assert isinstance(found, HostTree)
        np.testing.assert_array_equal(found.points, expected.points)
    elif hasattr(expected, "__dataclass_fields__"):
        for name in expected.__dataclass_fields__:
            assert_same(getattr(found, name), getattr(expected, name))
    else:
        assert found == expected


def truth_run() -> tuple[SlamMethods, list[np.ndarray]]:
    """Two rounds with loops, some empty scans and a kidnapping."""
    truth = laps(2, side_m=60.0, step_m=2.0)
    scans = scans_of([*range(200), *range(40, 90)])
    scans[17] = scans[170] = EMPTY
    return SlamMethods(TruthMatcher(truth), TruthGeometry(truth, sigma_m=0.03), CONFIG), scans


@pytest.mark.slow
def test_a_run_that_is_cut_off_anywhere_goes_on_like_an_unbroken_one(tmp_path) -> None:
    methods, scans = truth_run()
    whole_state, whole_reports = recorded(methods, scans, tmp_path / "whole")
    assert any(loop.status == "accepted" for loop in whole_state.loops.loops)
    assert "restarted" in {report.status for report in whole_reports}
    content = (tmp_path / "whole").read_bytes()
    rng = np.random.default_rng(0)
    for length in [len(content), 22, *rng.integers(22, len(content), 8)]:
        path = tmp_path / "cut"
        path.write_bytes(content[:length])
        found = read_journal(path, methods, scans.__getitem__)
        state, reports = recorded(methods, scans, path, found)
        assert_same(state, whole_state)
        assert_same(tuple(reports), tuple(whole_reports))
        assert path.read_bytes() == content
    result = finish_slam(state, reports, methods.config)
    np.testing.assert_array_equal(
        result.T_world_scan, finish_slam(whole_state, whole_reports, methods.config).T_world_scan
    )


def test_a_flipped_byte_ends_what_is_read(tmp_path) -> None:
    methods, scans = truth_run()
    recorded(methods, scans[:60], tmp_path / "journal")
    content = bytearray((tmp_path / "journal").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "journal").write_bytes(content)
    found = read_journal(tmp_path / "journal", methods, scans.__getitem__)
    assert 0 < len(found.reports) < 60
    assert found.num_bytes <= len(content) // 2


@pytest.mark.parametrize("content", [b"", b"PK\3\4", b"dpmjax SLAM journal 0\n"])
def test_another_file_is_refused(tmp_path, content: bytes) -> None:
    methods, scans = truth_run()
    (tmp_path / "journal").write_bytes(content)
    with pytest.raises(ValueError, match="no journal of this version"):
        read_journal(tmp_path / "journal", methods, scans.__getitem__)


def test_the_journal_keeps_what_networks_and_surfaces_say(tmp_path) -> None:
    rng = np.random.default_rng(0)
    world = planes(rng)
    scans = [seen_from(world, motion(0.4 * step, 0.0, 2.0 * step)) for step in range(12)]
    model = dpmjax.init_model(jax.random.key(0), toy.MODEL)
    config = replace(CONFIG, loops=replace(CONFIG.loops, is_on=False))
    methods = make_methods(model, config)
    whole_state, whole_reports = recorded(methods, scans, tmp_path / "journal")
    found = read_journal(tmp_path / "journal", methods, scans.__getitem__)
    assert len(found.state.slam_map) > 1
    state, reports = recorded(methods, scans, tmp_path / "journal", found)
    assert_same(state, whole_state)
    assert_same(tuple(reports), tuple(whole_reports))


class Record(NamedTuple):
    number: int
    text: str
    array: np.ndarray
    perhaps: float | None = None


def test_columns_give_the_records_back() -> None:
    records = [
        Record(1, "a", np.eye(2), 0.1),
        Record(2**40, "b c", np.zeros((2, 2))),
        Record(-3, "", np.ones((2, 2)), np.inf),
    ]
    for part in (records, records[:1], records[1:2], []):
        assert_same(tuple(from_columns(Record, to_columns(part, "record"), "record")), tuple(part))
