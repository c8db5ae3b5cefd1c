"""MATLAB files; SciPy writes them and is the oracle."""

import io

import numpy as np
import pytest
from scipy.io import savemat

from dpmjax.io import InputError
from dpmjax.io.files import parse_mat

VALUES = {
    "pose": np.arange(12.0).reshape(4, 3),
    "small": np.array([[1, 2]], np.uint8),
    "integers": np.arange(-3, 3, dtype=np.int32).reshape(2, 3),
    "cube": np.random.default_rng(0).normal(size=(2, 3, 4)).astype(np.float32),
    "name": "Home_001",
    "empty": np.zeros((0, 3)),
}


def content_of(variables, **options):
    buffer = io.BytesIO()
    savemat(buffer, variables, **options)
    return buffer.getvalue()


@pytest.mark.parametrize("is_packed", [False, True])
def test_numbers_and_text_are_what_was_written(is_packed):
    found = parse_mat(content_of(VALUES, do_compression=is_packed), "a.mat")
    assert list(found) == list(VALUES)
    for name, value in VALUES.items():
        np.testing.assert_array_equal(found[name], value)


def test_structs_are_dictionaries_and_cells_lists():
    structs = np.zeros(2, [("name", object), ("R", object), ("nothing", object)])
    structs[0], structs[1] = ("a", np.eye(3), np.zeros(0)), ("b", np.ones((3, 1)), np.zeros(0))
    cells = np.array([np.eye(2), "text"], object)
    found = parse_mat(content_of({"structs": structs, "cells": cells}, do_compression=True), "a.mat")
    assert [entry["name"] for entry in found["structs"]] == ["a", "b"]
    np.testing.assert_array_equal(found["structs"][0]["R"], np.eye(3))
    np.testing.assert_array_equal(found["structs"][1]["R"], np.ones((3, 1)))
    np.testing.assert_array_equal(found["cells"][0], np.eye(2))
    assert found["cells"][1] == "text"


@pytest.mark.parametrize("length", [0, 100, 130, 150, 200])
def test_truncated_files_are_refused(length):
    with pytest.raises(InputError, match=r"a\.mat: not a readable MATLAB file"):
        parse_mat(content_of({"pose": np.eye(9)})[:length], "a.mat")
