import dataclasses
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deeppointmap import Model, ModelConfig, model_preset
from dpmjax.weights import load_model, read_card, save_model
from dpmjax.weights.config_json import config_from_json
from dpmjax.weights.torch_import import read_torch_file
from tests.optional import import_or_skip
from tests.weights.published import published_tensors


@pytest.fixture
def torch() -> Any:
    return import_or_skip("torch")


def assert_same(a: Model, b: Model, rtol: float = 0) -> None:
    assert a.config == b.config
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol / 100), a.params, b.params)


def test_saved_model_is_the_loaded_one(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path / "m.safetensors", card="trained on a town")
    assert_same(load_model(tmp_path / "m.safetensors"), model)
    assert read_card(tmp_path / "m.safetensors") == "trained on a town"
    assert load_model(tmp_path / "m.safetensors").config.trained == ("registration", "overlap")
    (tmp_path / "other").touch()  # who may read the folder may read the model
    assert (tmp_path / "m.safetensors").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_half_precision_costs_three_digits_and_is_half_the_size(model: Model, tmp_path: Path) -> None:
    for dtype in ("float16", "float32"):
        save_model(model, tmp_path / f"{dtype}.safetensors", dtype=dtype)
    half = load_model(tmp_path / "float16.safetensors")
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(half.params))
    assert_same(half, model, rtol=1e-3)
    sizes = [(tmp_path / f"{dtype}.safetensors").stat().st_size for dtype in ("float16", "float32")]
    # The header, which is longer where the numbers in it are, is padded.
    assert sizes[1] - sizes[0] == pytest.approx(2 * sum(leaf.size for leaf in jax.tree.leaves(model.params)), abs=256)


@pytest.mark.parametrize("config", [model_preset("tiny"), model_preset("paper")], ids=["tiny", "paper"])
def test_configuration_survives_json(config: ModelConfig) -> None:
    assert config_from_json(json.loads(json.dumps(dataclasses.asdict(config))), ModelConfig) == config


def test_wrong_configurations_are_named() -> None:
    with pytest.raises(ValueError, match="ModelConfig: unknown field 'colour'"):
        config_from_json({"colour": 1}, ModelConfig)
    with pytest.raises(ValueError, match="ModelConfig.encoder.stem_channels: expected int, got 'x'"):
        config_from_json({"encoder": {"stem_channels": "x"}}, ModelConfig)
    # A file of another version is read without it.
    assert config_from_json({"colour": 1, "scale_m": 2.0}, ModelConfig, file="old.safetensors").scale_m == 2.0


def test_full_size_checkpoint_is_loaded_by_its_tensors(torch: Any, tmp_path: Path) -> None:
    config = ModelConfig()
    tensors = published_tensors(config)
    torch.save(jax.tree.map(torch.tensor, tensors), tmp_path / "x.pth")
    model = load_model(tmp_path / "x.pth")
    assert model.config == config
    kernel = tensors["encoder"]["downsampler.2.irm.1.pw_conv.0.weight"][:, :, 0].T
    np.testing.assert_array_equal(model.params["encoder"]["stage_2"]["inverted_residual_1"]["expand"]["kernel"], kernel)
    kernel = tensors["decoder"]["descriptor_attention.2.cross_attn.in_proj_weight"].T
    np.testing.assert_array_equal(model.params["decoder"]["layer_2"]["cross_attention"]["in_kernel"], kernel)


def test_old_format_is_read_by_pytorch(torch: Any, model: Model, tmp_path: Path) -> None:
    content = {"a": torch.arange(6.0).reshape(2, 3).T, "b": {"c": torch.ones(2, dtype=torch.float16)}}
    torch.save(content, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    torch.save(content, tmp_path / "new.pth")
    for name in ("old.pth", "new.pth"):
        found = read_torch_file(tmp_path / name)
        np.testing.assert_array_equal(found["a"], np.arange(6.0).reshape(2, 3).T)
        np.testing.assert_array_equal(found["b"]["c"], np.ones(2))


def test_parameters_and_ordered_dictionaries_are_read(torch: Any, tmp_path: Path) -> None:
    torch.save(torch.nn.Linear(2, 3).state_dict(), tmp_path / "x.pth")
    shapes = {name: array.shape for name, array in read_torch_file(tmp_path / "x.pth").items()}
    assert shapes == {"weight": (3, 2), "bias": (3,)}


def archive(path: Path, content: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("x/data.pkl", content)
    return path


class Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("exit 1",)


def test_tensor_beyond_its_storage_is_refused(tmp_path: Path) -> None:
    content = pickle.PROTO + b"\x02ctorch._utils\n_rebuild_tensor_v2\n("
    # persistent id ('storage', torch.FloatStorage, '0', 'cpu', 2), then offset 0, shape (3,), strides (1,)
    content += b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x02tQ"
    path = archive(tmp_path / "x.pth", content + b"K\x00(K\x03t(K\x01t\x89}tR.")
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("x/data/0", np.ones(2, np.float32).tobytes())
    with pytest.raises(ValueError, match="reaches beyond its storage"):
        read_torch_file(path)


FOREIGN = {
    "which is no tensor": pickle.dumps({"encoder": Evil()}),
    "expected a dictionary of encoder and decoder": pickle.dumps({"encoder": {}}),
    "encoder: unknown tensor point_mlp9.weight": pickle.dumps({"encoder": {"point_mlp9.weight": 1}, "decoder": {}}),
    "0 stages": pickle.dumps({"encoder": {}, "decoder": {}}),
}


@pytest.mark.parametrize("message", FOREIGN)
def test_foreign_checkpoints_are_refused_and_run_nothing(message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load_model(archive(tmp_path / "x.pth", FOREIGN[message]))


def test_broken_and_missing_files_are_named(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path / "whole.safetensors")
    content = (tmp_path / "whole.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(content[: len(content) // 2])
    (tmp_path / "old.pth").write_bytes(b"\x80\x02no archive")
    for name, message in (
        ("cut.safetensors", "cut.safetensors: not a whole safetensors file"),
        ("none.safetensors", "none.safetensors: no such file"),
        ("none.pth", "none.pth: no such file"),
        ("old.pth", "old.pth: not a checkpoint of PyTorch 1.6 or later"),
    ):
        with pytest.raises(ValueError, match=message):
            load_model(tmp_path / name)


def test_parameters_that_half_precision_cannot_hold_are_refused(model: Model, tmp_path: Path) -> None:
    large = Model(jax.tree.map(lambda leaf: leaf + 1e6, model.params), model.config)
    with pytest.raises(ValueError, match="not finite in float16"):
        save_model(large, tmp_path / "x.safetensors", dtype="float16")
