"""PCD files as the Point Cloud Library and drivers write them: compressed, padded."""

from pathlib import Path

import numpy as np
import pytest

from dpmjax.io import InputError, read_lidar_file
from dpmjax.io.clouds import unpack_lzf
from dpmjax.io.lidar_file import read_point_times
from tests.data_sets import read_pcd

NUM = 500


@pytest.fixture
def points() -> np.ndarray:
    """Points of a room: many equal coordinates, so that compression finds copies."""
    rng = np.random.default_rng(0)
    return np.round(rng.uniform(-8, 8, (NUM, 3)), 1).astype("<f4")


def header(fields: str, sizes: str, types: str, counts: str, encoding: str, num_points: int = NUM) -> bytes:
    return (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
        f"COUNT {counts}\nWIDTH {num_points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {num_points}\nDATA {encoding}\n"
    ).encode()


ROWS = np.array([[1, 2, 3], [4, 5, 6], [-7, 8.5, 0]], "<f4")


def plain(fields: str = "x y z", encoding: str = "ascii", body: bytes = b"1 2 3\n4 5 6\n-7 8.5 0\n", **kinds) -> bytes:
    num, each = len(fields.split()), {"size": "4", "kind": "F", "num_points": 3, **kinds}
    sizes, types = (" ".join([each[name]] * num) for name in ("size", "kind"))
    return header(fields, sizes, types, " ".join(["1"] * num), encoding, each["num_points"]) + body


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (plain(), ROWS),
        (plain(encoding="binary", body=ROWS.tobytes()), ROWS),
        (plain("z intensity y x", body=b"3 0 2 1\n6 0 5 4\n0 0 8.5 -7\n"), ROWS),
        (plain("z y x", "binary", ROWS[:, ::-1].tobytes()), ROWS),
        (plain(encoding="binary", body=ROWS.astype("<f8").tobytes(), size="8"), ROWS),
        (plain("x y", body=b"1 2\n4 5\n-7 8.5\n"), ROWS * [1, 1, 0]),
    ],
)
def test_points_are_read_whatever_the_encoding_and_order(tmp_path: Path, content: bytes, expected: np.ndarray) -> None:
    (tmp_path / "a.pcd").write_bytes(content)
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd"), expected)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "no PCD header"),
        (b"hello\nworld\n", "no PCD header"),
        (plain(encoding="binary", body=ROWS.tobytes()[:-5]), "truncated"),
        (plain(body=b"1 2 3\n"), "truncated"),
        (plain(body=b"1 2 3\n4 5\n6 7 8\n"), "row 2 is not 3 numbers"),
        (plain(body=b"1 2 3\n4 x 5\n6 7 8\n"), "row 2 is not 3 numbers: '4 x 5'"),
        (plain("x z w"), "column y"),
        (plain(encoding="packed"), "broken PCD header"),
        (plain(encoding="binary_compressed"), "truncated"),
        (plain(num_points=-1), "broken PCD header"),
        (plain(kind="Q"), "broken PCD header"),
    ],
)
def test_bad_file_is_told_in_one_line_with_its_name(tmp_path: Path, content: bytes, found: str) -> None:
    (tmp_path / "bad.pcd").write_bytes(content)
    with pytest.raises(InputError, match=rf"bad\.pcd.*{found}") as caught:
        read_pcd(tmp_path / "bad.pcd")
    assert "\n" not in str(caught.value)


def pack_lzf(data: bytes) -> bytes:
    """Slow oracle: literals, and copies of the longest match among the last 300 bytes."""
    out, literals, at = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend([len(run) - 1, *run])
        literals.clear()

    while at < len(data):
        length, distance = 0, 0
        for back in range(1, min(at, 300) + 1):
            n = 0
            while n < 264 and at + n < len(data) and data[at + n] == data[at - back + n]:
                n += 1
            if n > length:
                length, distance = n, back
        if length < 3:
            literals.append(data[at])
            at += 1
            continue
        flush()
        code, low, high = length - 2, (distance - 1) & 255, (distance - 1) >> 8
        out.extend([(code << 5) | high, low] if code < 7 else [(7 << 5) | high, code - 7, low])
        at += length
    flush()
    return bytes(out)


def compressed(columns: list[np.ndarray]) -> bytes:
    values = b"".join(column.tobytes() for column in columns)
    packed = pack_lzf(values)
    return np.array([len(packed), len(values)], "<u4").tobytes() + packed


@pytest.mark.parametrize("content", [b"", b"a", b"abc" * 200, bytes(1000), np.random.default_rng(1).bytes(3000)])
def test_lzf_gives_back_what_was_packed(content: bytes) -> None:
    assert unpack_lzf(pack_lzf(content), len(content)) == content


def test_compressed_columns_are_read_with_their_times(tmp_path: Path, points: np.ndarray) -> None:
    times = np.arange(NUM, dtype="<f8") * 1e-4
    rings = (np.arange(NUM) % 16).astype("<u2")
    head = header("ring x y z timestamp", "2 4 4 4 8", "U F F F F", "1 1 1 1 1", "binary_compressed")
    (tmp_path / "a.pcd").write_bytes(head + compressed([rings, *points.T, times]))
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd"), points)
    np.testing.assert_array_equal(read_point_times(tmp_path / "a.pcd"), times)


@pytest.mark.parametrize("has_padding", [False, True])
def test_compressed_columns_may_leave_the_padding_out(tmp_path: Path, points: np.ndarray, has_padding: bool) -> None:
    padding = [np.zeros(4 * NUM, "u1")] if has_padding else []
    head = header("x y z _", "4 4 4 1", "F F F U", "1 1 1 4", "binary_compressed")
    (tmp_path / "a.pcd").write_bytes(head + compressed([*points.T, *padding]))
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd"), points)


@pytest.mark.parametrize("damage", ["cut", "sizes", "copy before the first byte", "bits"])
def test_damaged_compression_is_named(tmp_path: Path, points: np.ndarray, damage: str) -> None:
    head = header("x y z", "4 4 4", "F F F", "1 1 1", "binary_compressed")
    body = bytearray(compressed(list(points.T)))
    if damage == "cut":
        body = body[:-9]
    elif damage == "sizes":
        body[4:8] = np.array([2**31], "<u4").tobytes()
    elif damage == "bits":
        body[0:4] = np.array([len(body) - 40], "<u4").tobytes()
    else:
        body[8:10] = bytes([0x3F, 0xFF])
    (tmp_path / "a.pcd").write_bytes(head + body)
    with pytest.raises(InputError, match=r"a\.pcd: .*(truncated|damaged|do not fit)"):
        read_pcd(tmp_path / "a.pcd")


def test_fields_behind_a_padding_of_0_are_left_out(tmp_path: Path, points: np.ndarray) -> None:
    """The Point Cloud Library writes a padding of 0 before a double that it aligns, and takes it off elsewhere."""
    kinds = {"p": ("<f4", 3), "intensity": "<f4", "timestamp": "<f8", "ring": "<u2"}
    layout = {"names": list(kinds), "formats": list(kinds.values()), "offsets": [0, 16, 24, 32], "itemsize": 48}
    records = np.zeros(NUM, np.dtype(layout))
    records["p"] = points
    fields, sizes = "x y z _ intensity _ timestamp _ ring _", "4 4 4 1 4 1 8 1 2 1"
    head = header(fields, sizes, "F F F U F U F U U U", "1 1 1 4 1 0 1 6 1 12", "binary")
    (tmp_path / "a.pcd").write_bytes(head + records.tobytes())
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd"), points)
    assert read_point_times(tmp_path / "a.pcd") is None


@pytest.mark.parametrize("is_padded", [False, True])
def test_rows_of_text_may_leave_the_padding_out(tmp_path: Path, is_padded: bool) -> None:
    head = header("x y z _ intensity", "4 4 4 1 4", "F F F U F", "1 1 1 4 1", "ascii", 2)
    padding = "0 0 0 0 " if is_padded else ""
    (tmp_path / "a.pcd").write_text(head.decode() + f"1 2 3 {padding}9\n4 5 6 {padding}9\n")
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd"), [[1, 2, 3], [4, 5, 6]])


def test_a_real_file_with_miscounted_padding_is_read(real_data: Path) -> None:
    found = read_lidar_file(real_data / "field_3d" / "pcd_padding_count_0" / "000950.pcd")
    assert len(found) == 5000
    assert np.median(np.linalg.norm(found, axis=1)) == pytest.approx(44.5, abs=0.1)


def test_a_map_in_national_coordinates_is_refused_with_an_origin(real_data: Path) -> None:
    path = real_data / "field_3d" / "pcd_binary_compressed" / "samp24-utm.pcd"
    assert len(read_pcd(path)) == 7492
    with pytest.raises(InputError, match=r"UTM; subtract an origin such as 513808 5403150 298"):
        read_lidar_file(path)
