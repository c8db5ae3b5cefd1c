"""Wrong usage of every subcommand: one line, exit code 2, nothing written."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("graph", "GRAPH"),
        ("graph a.g2o --iterations 0", "--iterations: expected at least 1, got 0"),
        ("graph none.g2o", "none.g2o: no such file"),
        ("register none.pcd b.npy", "none.pcd"),
        ("map2d none.log", "none.log"),
        ("depth none", "none"),
        ("localize none.npz scans", "none.npz"),
        ("merge none.npz other.npz", "none.npz"),
        ("graph a.g2o --outlier-chi2 -1", "--outlier-chi2: expected more than 0"),
        ("register a.pcd b.pcd --columns 2", "--columns: expected at least 3"),
        ("evaluate nowhere", "nowhere"),
        ("evaluate --weights no_such_model", "no_such_model"),
        ("evaluate --pairs 0", "--pairs"),
        ("slam -n 0", "--n-scans"),
        ("slam -j 0", "--jump"),
        ("slam --sequence 00", "--sequence"),
        ("slam --topic /points", "--topic"),
        ("slam --columns 4", "--columns"),
        ("slam a b", "--cluster: give it with two or more DATA"),
        ("slam a --cluster local", "--cluster: give it with two or more DATA"),
        ("slam a b --cluster local --map m.npz", "--cluster: leave --map"),
        ("slam a b --cluster local --odometry odometry.txt", "--cluster: leave --map"),
        ("slam /no/a /no/b --cluster local", "no such file or folder"),
        ("slam --base-from-lidar 0 0 0 0 0 0", "--base-from-lidar"),
        ("slam --base-from-lidar 0 0 1 0 0 1 1", "--base-from-lidar"),
        ("slam /no/such/folder", "no such file or folder"),
        ("slam --weights no_such_model", "no_such_model"),
        ("slam --resume -o /no/such/run", "it is no run of slam"),
        ("slam --resume --sequence 00 -o /no/such/run", "it is no run of slam"),
        ("merge", "two or more maps"),
        ("merge a.npz", "two or more maps"),
        ("map2d --jump 0", "--jump"),
        ("map2d --n-scans 0", "--n-scans"),
        ("map2d --seconds -1", "--seconds: expected more than 0"),
        ("map2d --steps 0", "--steps"),
        ("map2d --no-ordered --init icp-plane", "--no-ordered"),
        ("map2d --topic /scan", "--topic"),
        ("train --steps 1", "--steps"),
        ("train --num-towns 0", "--num-towns"),
        ("train --epochs 0", "--epochs"),
        ("train --epochs 3 --steps 100", "--epochs: expected without --steps"),
        ("train --variants -1", "--variants"),
        ("train --stages overlap", "--stages overlap trains the head of a model"),
        ("train --stages", "--stages: expected registration, overlap, or both"),
        ("train --data nowhere", "nowhere"),
        ("train --seed -1", "--seed: expected at least 0"),
    ],
)
def test_wrong_usage_is_told_in_one_line(refused, command: str, message: str) -> None:
    assert message in refused(*command.split())
