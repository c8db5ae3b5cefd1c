"""Made-up inputs: every reader ends in a good result or in an `InputError` of one line, and so does the command."""

import gzip
import os
import re
import tarfile
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import dpmjax
from dpmjax import io
from dpmjax.sequences import InputError, LidarSequence, ScanSequence
from tests.data_sets import readable_scans, write_deepmapping_folder, write_pcd
from tests.io import drives
from tests.io.bag_files import EPOCH_NS, KINDS, BagWriter
from tests.io.depth_files import write_pose_folder, write_scene
from tests.io.test_g2o import EDGES, PLANAR, spatial_text
from tests.io.test_las import write_las
from tests.io.test_pcd import compressed
from tests.io.test_pcd import header as pcd_header

NUM_FUZZED = int(os.environ.get("DPMJAX_NUM_FUZZED", "2000"))
MOST_VALUES = 10**7  # A result that is larger than this comes from a header, for no file here has 100 kB.

Write = Callable[[Path, np.random.Generator], Path]
Read = Callable[[Path], object]


def points_2d(rng):
    angles = np.linspace(0, 6, 24)
    return rng.uniform(2, 9, (4, 24, 1)) * np.stack([np.cos(angles), np.sin(angles)], -1)


def cloud(rng):
    return rng.normal(size=(40, 3)).astype(np.float32) * [10, 10, 1]


def arrays_2d(rng):
    return {"points": points_2d(rng), "poses": rng.normal(size=(4, 3)), "times": np.arange(4.0), "unit": "m"}


def log_bytes(rng):
    lines = [
        f"FLASER 20 {' '.join(f'{r:.2f}' for r in rng.uniform(1, 9, 20))} {i} 0 0 {i} 1 0 {i} h {i}" for i in range(4)
    ]
    return ("# log\n" + "\n".join(lines) + "\n").encode()


def at(name: str, write: Callable[[Path, np.random.Generator], object]) -> Write:
    def write_file(folder: Path, rng: np.random.Generator) -> Path:
        write(folder / name, rng)
        return folder / name

    return write_file


def write_pcd_folder(folder, rng):
    mask = np.ones((4, 24), bool)
    points = 30 * points_2d(rng).astype(np.float32)
    scans = ScanSequence("s", points, mask, "px", reference_poses=rng.normal(size=(4, 3)))
    return write_deepmapping_folder(folder / "scans", scans)


def write_pcd_tar(folder, rng):
    home = write_pcd_folder(folder, rng)
    with tarfile.open(folder / "a.tar", "w") as archive:
        archive.add(home, "scans")
    return folder / "a.tar"


def ascii_rows(rng, more: str = "") -> str:
    return "".join(f"{x} {y} {z}{more}\n" for x, y, z in cloud(rng))


ASCII_PCD = pcd_header("x y z i", "4 4 4 4", "F F F U", "1 1 1 1", "ascii", 40).decode()
ASCII_PLY = "ply\nformat ascii 1.0\nelement vertex 40\n" + "".join(f"property float {name}\n" for name in "xyz")


def trajectory(rng):
    return np.column_stack([rng.uniform(-9, 9, (5, 2)), rng.uniform(-3, 3, 5)])


def write_drive(folder, rng, *, kind):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = range(3)
    drives.WRITERS[kind](folder, [cloud(rng) for _ in range(3)], poses)
    return folder


def pcd_bytes(rng, *, kind):
    points = np.round(cloud(rng), 1).astype("<f4")
    if kind == "compressed":
        return pcd_header("x y z", "4 4 4", "F F F", "1 1 1", "binary_compressed", 40) + compressed(list(points.T))
    records = np.zeros(40, [("p", "<f4", 3), ("a", "u1", 4), ("t", "<f8"), ("b", "u1", 8)])
    records["p"] = points
    return pcd_header("x y z _ t _", "4 4 4 1 8 1", "F F F U F U", "1 1 1 4 1 8", "binary", 40) + records.tobytes()


def write_bag(folder, rng, *, kind):
    with BagWriter(folder / "a", kind) as bag:
        for index in range(3):
            bag.write_cloud(cloud(rng), EPOCH_NS + index * 10**8, times_s=np.zeros(40))
    return bag.path


def write_planar_bag(folder, rng, *, kind):
    with BagWriter(folder / "a", kind) as bag:
        bag.write_transform(("base", "laser"), np.zeros(3), EPOCH_NS, topic="/tf_static")
        for index in range(3):
            stamp = EPOCH_NS + index * 10**8
            bag.write_odometry(np.array([index, 0, 0]), stamp)
            bag.write_scan(rng.uniform(1, 9, 24), stamp)
    return bag.path


def write_plain_drive(folder, rng):
    for index in range(3):
        write_pcd(folder / f"{index}.pcd", cloud(rng))
    (folder / "times.txt").write_text("10.0\n10.1\n10.2\n")
    io.write_tum(folder / "groundtruth.txt", np.tile(np.eye(4), (20, 1, 1)), times=10 + 0.01 * np.arange(20))
    return folder


TORO_PLANAR = "VERTEX2 1 0 0 0\nVERTEX2 2 1 0 0.1\nEDGE2 1 2 1 0 0.1 9 0 9 9 0 0\nEQUIV 1 2\n"
GRAPHS = {"toro": TORO_PLANAR, "edges": EDGES, "planar": PLANAR, "spatial": spatial_text()[0]}


def read_drive(path):
    sequence = io.open_lidar_sequence(path)
    return [sequence, list(readable_scans(sequence).values())]


SCANS = {
    "npy": at("a.npy", lambda path, rng: np.save(path, points_2d(rng))),
    "npz": at("a.npz", lambda path, rng: np.savez(path, **arrays_2d(rng))),
    "packed npz": at("a.npz", lambda path, rng: np.savez_compressed(path, **arrays_2d(rng))),
    "ranges": at(
        "a.npz", lambda path, rng: np.savez(path, ranges=rng.uniform(1, 9, (4, 24)), angles=np.linspace(0, 6, 24))
    ),
    "log": at("a.log", lambda path, rng: path.write_bytes(log_bytes(rng))),
    "packed log": at("a.log.gz", lambda path, rng: path.write_bytes(gzip.compress(log_bytes(rng)))),
    "pcd folder": write_pcd_folder,
    "pcd tar": write_pcd_tar,
}
LIDAR_FILES = {
    "bin": at("0.bin", lambda path, rng: drives.write_bin(path, cloud(rng))),
    "npy": at("0.npy", lambda path, rng: np.save(path, cloud(rng))),
    "pcd": at("0.pcd", lambda path, rng: write_pcd(path, cloud(rng))),
    "ascii pcd": at("0.pcd", lambda path, rng: path.write_text(ASCII_PCD + ascii_rows(rng, " 7"))),
    "ply": at("0.ply", lambda path, rng: io.write_ply(path, cloud(rng))),
    "ascii ply": at("0.ply", lambda path, rng: path.write_text(f"{ASCII_PLY}end_header\n{ascii_rows(rng)}")),
    "pcd, compressed": at("0.pcd", lambda path, rng: path.write_bytes(pcd_bytes(rng, kind="compressed"))),
    "pcd, padded": at("0.pcd", lambda path, rng: path.write_bytes(pcd_bytes(rng, kind="padded"))),
    "las": at("0.las", lambda path, rng: write_las(path, cloud(rng).astype(float), times=np.arange(40.0))),
    "laz": at("0.laz", lambda path, rng: write_las(path, cloud(rng).astype(float), times=np.arange(40.0))),
}
POSES = {
    "tum": at("t.txt", lambda path, rng: io.write_tum(path, trajectory(rng))),
    "kitti": at("k.txt", lambda path, rng: io.write_kitti(path, trajectory(rng))),
    "npy": at("p.npy", lambda path, rng: io.write_poses_npy(path, trajectory(rng))),
    "columns": at("a.txt", lambda path, rng: np.savetxt(path, trajectory(rng), header="x_m y_m theta_rad")),
}
CASES: dict[str, tuple[Write, Read]] = {
    **{f"scans, {name}": (write, io.read_sequence) for name, write in SCANS.items()},
    **{f"lidar file, {name}": (write, io.read_lidar_file) for name, write in LIDAR_FILES.items()},
    **{f"poses, {name}": (write, io.read_poses) for name, write in POSES.items()},
    **{f"planar, {name}": (write, lambda path: io.read_planar_poses(path, 5, "m")) for name, write in POSES.items()},
    **{f"drive, {kind}": (partial(write_drive, kind=kind), read_drive) for kind in drives.WRITERS},
    "drive, plain": (write_plain_drive, read_drive),
    **{f"drive, {kind}": (partial(write_bag, kind=kind), read_drive) for kind in KINDS},
    **{f"scans, {kind}": (partial(write_planar_bag, kind=kind), io.read_sequence) for kind in KINDS},
    **{
        f"graph, {name}": (at("a.g2o", lambda path, _, text=text: path.write_text(text)), dpmjax.read_g2o)
        for name, text in GRAPHS.items()
    },
    "depth folder": (
        lambda folder, _: write_pose_folder(folder),
        lambda path: io.read_pose_folder(path, height=6, width=8),
    ),
    "depth scene": (
        lambda folder, _: write_scene(folder),
        lambda path: io.read_active_vision(path, 3, height=6, width=8),
    ),
}

HUGE = (b"99999999999", b"-1", b"1e308", b"nan", b"inf", b"0", b"", b"x", b"4294967297", b"1e999", b"\xff", b"-nan")


def spoil_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """One of: bits turned, bytes cut out or repeated, the end cut off, a number replaced by an odd one."""
    data = bytearray(content)
    kind = rng.integers(7)
    if kind == 0:
        for at in rng.integers(len(data), size=rng.integers(1, 9)):
            data[at] ^= 1 << rng.integers(8)
    elif kind == 1:
        data = data[: rng.integers(len(data))]
    elif kind == 2:
        at = rng.integers(len(data))
        del data[at : at + rng.integers(1, 64)]
    elif kind == 3:
        at = rng.integers(len(data))
        data[at:at] = data[at : at + rng.integers(1, 64)]
    elif kind == 4:
        at = rng.integers(len(data))
        size = rng.integers(1, 9)
        data[at : at + size] = bytes([int(rng.choice([0, 255, 127, 32, 48, 10]))]) * size
    else:  # in front, where headers are, or anywhere
        numbers = list(re.finditer(rb"-?\d+(\.\d+)?", bytes(data[:400] if kind == 5 else data)))
        if numbers:
            number = numbers[rng.integers(len(numbers))]
            data[number.start() : number.end()] = HUGE[rng.integers(len(HUGE))]
    return bytes(data)


def spoil(path: Path, rng: np.random.Generator) -> None:
    """Damages one or two files of an input; now and then one is emptied, removed, or replaced by another."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    for file in rng.permutation(len(files))[: rng.integers(1, 3)]:
        chosen, kind = files[file], rng.integers(12)
        if kind == 0:
            chosen.write_bytes(b"")
        elif kind == 1 and len(files) > 1:
            chosen.unlink()
        elif kind == 2:
            chosen.write_bytes(rng.bytes(rng.integers(1, 3000)))
        else:
            chosen.write_bytes(spoil_bytes(chosen.read_bytes() or b"0", rng))


def spoil_arrays(path: Path, rng: np.random.Generator) -> None:
    shape = tuple(int(n) for n in rng.choice([0, 1, 2, 3, 4, 5, 20], size=rng.integers(0, 5)))
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-40, 41)
    values = np.where(rng.random(shape) < rng.choice([0, 0.1, 1]), rng.choice([np.nan, np.inf, 0.0, -np.inf]), values)
    dtype = rng.choice(["f8", "f4", "f2", "i8", "u1", "?", "c8", "U3", "S2", "M8[s]"])
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if dtype in ("i8", "u1", "M8[s]"):
            values = np.nan_to_num(values, posinf=1, neginf=0)
        values = values.astype(dtype)
    if path.suffix == ".npy":
        np.save(path, values)
        return
    with np.load(path) as table:
        arrays = dict(table)
    arrays[str(rng.choice([*arrays, "mask", "odometry"]))] = values
    np.savez(path, **arrays)


def total_size(result: object) -> int:
    if isinstance(result, list):
        return sum(total_size(entry) for entry in result)
    arrays = [result] if isinstance(result, np.ndarray) else getattr(result, "__dict__", {}).values()
    return sum(array.size for array in arrays if isinstance(array, np.ndarray))


def assert_good(result: object) -> None:
    assert total_size(result) < MOST_VALUES
    if isinstance(result, ScanSequence):
        assert np.isfinite(result.points).all()
        assert result.mask.any(axis=1).all()
    if isinstance(result, np.ndarray):
        assert np.isfinite(result).all()
    if isinstance(result, list):
        sequence, scans = result
        assert isinstance(sequence, LidarSequence)
        assert all(np.isfinite(points).all() and len(points) for points in scans)
        T = sequence.T_world_lidar
        assert T is None or np.isnan(T[~sequence.has_reference]).all()


def make_input(name: str, seed: int, folder: Path) -> Path:
    rng = np.random.default_rng(seed)
    folder.mkdir()
    path = CASES[name][0](folder, rng)
    if path.suffix in (".npy", ".npz") and rng.random() < 0.4:
        spoil_arrays(path, rng)
    else:
        spoil(path, rng)
    return path


@pytest.mark.parametrize("name", CASES)
def test_unspoilt_inputs_are_read(tmp_path, name):
    write, read = CASES[name]
    assert_good(read(write(tmp_path, np.random.default_rng(0))))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_spoilt_inputs_end_in_one_line(tmp_path, name):
    count = -(-NUM_FUZZED // len(CASES))
    for seed in range(count):
        path = make_input(name, seed, tmp_path / str(seed))
        try:
            result = CASES[name][1](path)
        except InputError as error:
            message = str(error)
        except Exception as error:
            raise AssertionError(f"{name}, seed {seed}: {type(error).__name__}: {error}") from error
        else:
            message = ""
            assert_good(result)
        assert "\n" not in message


@pytest.mark.parametrize("claim", ["(99999999999,)", "(2147483647, 2)", "(0, 99999999999)", "(-4, 2)"])
def test_a_header_that_lies_allocates_nothing(tmp_path, claim):
    np.save(tmp_path / "a.npy", np.zeros((4, 2)))
    content = (tmp_path / "a.npy").read_bytes()
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {claim}, }}"
    (tmp_path / "a.npy").write_bytes(content[:10] + header.ljust(117).encode() + b"\n" + content[128:])
    with pytest.raises(InputError, match="NumPy"):
        io.read_sequence(tmp_path / "a.npy")
