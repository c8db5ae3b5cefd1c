"""MATLAB files: SciPy reads them, and a file that ends SciPy's process is refused in one line."""

import io

import numpy as np
import pytest
from scipy.io import savemat

from dpmjax.io import InputError
from dpmjax.io.files import load_mat


def content_of(variables, **options):
    buffer = io.BytesIO()
    savemat(buffer, variables, **options)
    return buffer.getvalue()


def test_numbers_text_and_structs_are_what_was_written():
    structs = np.zeros(2, [("name", object), ("R", object)])
    structs[0], structs[1] = ("a", np.eye(3)), ("b", np.zeros(0))
    pose = np.arange(12.0).reshape(4, 3)
    found = load_mat(content_of({"pose": pose, "scale": 3.0, "structs": structs}, do_compression=True), "a.mat")
    assert list(found) == ["pose", "scale", "structs"]
    np.testing.assert_array_equal(found["pose"], pose)
    assert found["scale"] == 3.0
    assert [entry["name"] for entry in found["structs"]] == ["a", "b"]
    np.testing.assert_array_equal(found["structs"][0]["R"], np.eye(3))


@pytest.mark.parametrize("damage", ["cut", "text", "unknown type of numbers"])
def test_damaged_files_are_refused(damage):
    whole = content_of({"pose": np.eye(9)})
    # Numbers of type 8, which MATLAB does not have, end the process of SciPy's reader.
    at = whole.index(np.array([9, 648], "<u4").tobytes())
    content = {"cut": whole[:200], "text": b"no matlab"}.get(damage, whole[:at] + b"\x08" + whole[at + 1 :])
    with pytest.raises(InputError, match=r"a\.mat: not a readable MATLAB file"):
        load_mat(content, "a.mat")
