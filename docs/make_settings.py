"""Writes docs/settings.md from the configuration dataclasses and the options of the command.

python docs/make_settings.py

Defaults come from the code. This file chooses the settings of the page and says when to change each of them.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
from dataclasses import MISSING, Field, fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from dpmjax.cli.options import RunOptions
from dpmjax.cli.program import COMMANDS

PAGE = Path(__file__).with_name("settings.md")


class Section(NamedTuple):
    """A dataclass: its module and name, how it is passed, and unit and advice of each setting."""

    name: str
    module: str
    use: str
    advice: dict[str, tuple[str, str]]


class Group(NamedTuple):
    """Sections of one task."""

    title: str
    sections: tuple[Section, ...]


SCANS_2D = Group("2-D scans", (
    Section("RegistrationConfig", "dpmjax.slam", "`register_scans(scans, config, key=key)`", {
        "is_ordered": ("", "False for scans without an order in time; the start is then the global search"),
        "refine": ("", "False: no candidate is refined"),
        "min_distance": ("unit of the scans", "0.5 m for whole recordings: nearer scans follow the odometry"),
        "min_turn": ("rad", "the same for turns"),
    }),
    Section("DeepMappingConfig", "dpmjax.deepmapping", "`fit_deepmapping(scans, config, key=key)`", {
        "cold_phases": ("", "phases from zero poses; see PhaseConfig"),
        "warm_phases": ("", "phases from given poses; see PhaseConfig"),
        "unit": ("unit of the scans", "512 px in `preset('paper')`; None: the typical range of the scans"),
        "steps_per_call": ("steps", "lower: progress and Ctrl-C react sooner; higher: less overhead on a GPU"),
    }),
    Section("PhaseConfig", "dpmjax.deepmapping", "`DeepMappingConfig(cold_phases=..., warm_phases=...)`", {
        "num_steps": ("steps", "more for large sets or noise; `deepmapping.with_steps(config, n)` scales all phases"),
        "num_epochs": ("epochs", "instead of `num_steps`, for steps in proportion to the number of scans"),
        "occupancy_weight": ("0 to 1", "weight of M-Net's loss beside the Chamfer distance; 0 leaves M-Net out"),
        "learning_rate": ("", "lower if the loss jumps, higher if 800 steps do not move the poses far enough"),

        "scans_per_step": ("scans", "fewer: less memory, noisier steps"),
        "beams_per_step": ("beams", "fewer: faster steps, noisier"),
        "max_offset": ("scans", "higher if places are seen again soon; lower if neighbouring scans hardly overlap"),
        "scans_per_window": ("scans", "shorter windows if scans are far apart; None: one L-Net for the whole set"),
    }),
))  # fmt: skip

SCANS_3D = Group("3-D scans", (
    Section("PreprocessConfig", "dpmjax.scan", "`ModelConfig.preprocess`; a trained model keeps its own", {
        "min_range_m": ("m", "higher if the vehicle itself is seen"),
        "max_range_m": ("m", "shorter indoors"),
        "voxel_size_m": ("m", "smaller for rooms; the network must be trained with it"),
        "num_outlier_neighbours": ("points", "0: no outlier test"),
        "capacity": ("points", "higher for dense scans of large places; memory grows with it"),
    }),
    Section("MatchConfig", "dpmjax.deeppointmap", "`register(model, a, b, config=config)`", {
        "pair_ratio": ("share", "more pairs find motions of smaller overlap, slower"),
        "consensus": ("", "None: the published rounds of inliers, for published weights"),
    }),
))  # fmt: skip

SLAM = Group("SLAM", (
    Section("OdometryConfig", "dpmjax.slam", "`SlamConfig(odometry=...)`", {
        "proposer": ("", "\"network\": the decoder proposes the motion of every scan, slower"),
        "num_keyframes": ("keyframes", "more: a larger local map, less drift, slower"),
    }),
    Section("FrontEndConfig", "dpmjax.slam", "`SlamConfig(front_end=...)`", {
        "keyframe_share": ("share of the median range", "higher: fewer keyframes, smaller maps, fewer loops"),
        "max_keyframe_m": ("m", "longest way between two keyframes"),
    }),
    Section("LoopClosureConfig", "dpmjax.slam", "`SlamConfig(loops=...)`", {
        "is_on": ("", "False: odometry alone (`--no-loop`)"),
        "min_probability": ("probability", "higher if wrong loops occur"),
    }),
    Section("DescriptorConfig", "dpmjax.slam", "`SlamConfig(method=\"descriptors\", descriptors=...)`", {
        "keyframe_m": ("m", "fewer keyframes; the paper has 10 for KITTI, 7 for KITTI-360, 3 for MulRan"),
        "min_confidence": ("score", "lower: fewer scans are dropped, more of their poses are wrong"),
        "max_rmse_m": ("m", "2.5 for `dpm_small`, whose offsets are not exact: with 0.5 nearly every scan is dropped"),
        "min_overlap": ("probability", "lower for more loops"),
    }),
    Section("LocalizationConfig", "dpmjax.slam", "`localize(model, slam_map, scan, config)`", {
        "min_best": ("probability", "lower: more scans are found, at a higher risk"),
    }),
    Section("PoseGraphConfig", "dpmjax.pose_graph", "`optimize_pose_graph(graph, config)`", {
        "outlier_chi2": ("chi2", "10 if edges may be wrong; None: plain least squares"),
        "max_iterations": ("solves", "more for large graphs from bad starts"),
        "tolerance": ("share of the cost", "smaller: more exact, slower"),
        "is_chordal_start": ("", "False: the given poses are the only start"),
    }),
))  # fmt: skip

TRAINING = Group("Training", (
    Section("TrainingConfig", "dpmjax.deeppointmap", "`train(drives, training_preset('small'))`", {
        "curriculum": ("", "stages of `CurriculumStage(max_group, num_steps)`; `config.with_steps(n)` scales all"),
        "num_epochs": ("epochs", "instead of the steps of the curriculum: passes over all scans"),
        "num_variants": ("variants", "more variants of each scan: more disk, less overfitting; 0: new ones each time"),
        "refines_labels": ("", "True where poses of neighbours are decimetres off"),
        "learning_rate": ("", "lower (1e-4) to tune trained weights on few scans"),
        "final_learning_rate": ("", "at the end of the cosine"),
        "max_gradient_norm": ("", "10 if the loss jumps"),
        "scans_at_once": ("scans", "more on a GPU, fewer if memory is short"),
    }),
    Section("SamplingConfig", "dpmjax.deeppointmap", "`TrainingConfig(sampling=...)`", {
        "num_scans": ("scans", "scans of one step; memory and time grow with it"),
        "max_distance_m": ("m", "larger: harder pairs"),
    }),
))  # fmt: skip

GROUPS = (SCANS_2D, SCANS_3D, SLAM, TRAINING)


def page() -> str:
    """Returns the text of docs/settings.md."""
    parts = [
        "# Settings\n",
        "<!-- Written by docs/make_settings.py: change that file, not this one. -->\n",
        "Settings that a user may change, with their defaults. Each record is a frozen dataclass:\n"
        "`dataclasses.replace(config, name=value)` changes one setting. Docstrings describe the remaining settings.\n"
        "The median range of a scan is about 12 m in a street and 4 m in a room; nine beams in ten stay below the\n"
        "typical range.\n",
    ]
    for group in GROUPS:
        parts.append(f"## {group.title}\n")
        parts += [section_text(section) for section in group.sections]
    parts.append("## Options of the command\n")
    parts.append(options_text("All runs", options_of(RunOptions)))
    parts += [command_text(name) for name in COMMANDS]
    return "\n".join(parts)


def section_text(section: Section) -> str:
    """Returns the table of one dataclass."""
    record = getattr(importlib.import_module(section.module), section.name)
    default_of = {field.name: default_text(field) for field in fields(record)}
    rows = [f"| `{name}` | {default_of[name]} | {unit} | {when} |" for name, (unit, when) in section.advice.items()]
    head = ["| setting | default | unit | when to change it |", "|---|---|---|---|"]
    use = f"`{section.module}.{section.name}`, for {section.use}\n"
    return "\n".join([f"### {section.name}\n", use, *head, *rows, ""])


def default_text(field: Field[Any]) -> str:
    """Returns a default as a user writes it; nested records by their names."""
    if field.default is MISSING and field.default_factory is MISSING:
        return "set by the preset"
    value = field.default_factory() if field.default is MISSING else field.default
    return value_text(value)


def value_text(value: Any) -> str:
    """Returns a value; nested records by their names."""
    if isinstance(value, tuple):
        return ", ".join(dict.fromkeys(value_text(one) for one in value)) or "none"
    name = getattr(value, "name", "")
    return f"{type(value).__name__}{f' {name!r}' if name else ''}" if is_dataclass(value) else str(value)


def command_text(name: str) -> str:
    """Returns the table of a subcommand's own options; empty where it has none."""
    common = options_of(RunOptions)
    config = get_type_hints(importlib.import_module(f"dpmjax.cli.{name}").main)["options"]
    return options_text(f"dpmjax {name}", [row for row in options_of(config) if row not in common])


def options_text(title: str, options: list[tuple[str, str, str]]) -> str:
    """Returns a table of options; empty where there are none."""
    rows = [f"| {option} | {default} | {text} |" for option, default, text in options]
    return "\n".join([f"### {title}\n", "| option | default | meaning |", "|---|---|---|", *rows, ""]) if rows else ""


def options_of(config: type) -> list[tuple[str, str, str]]:
    """Returns name, default and description of each option of a command's dataclass."""
    found: dict[str, tuple[str, str, str]] = {}
    default_of = {field.name: default_text(field) for field in fields(config)}
    for record in config.__mro__[:-1]:
        body = ast.parse(textwrap.dedent(inspect.getsource(record))).body[0].body  # type: ignore[attr-defined]
        for line, after in pairwise(body):
            if isinstance(line, ast.AnnAssign) and isinstance(after, ast.Expr) and line.target.id in default_of:
                row = option_row(line, default_of[line.target.id], after.value.value)
                found.setdefault(line.target.id, row)
    return list(found.values())


def option_row(line: ast.AnnAssign, default: str, description: str) -> tuple[str, str, str]:
    """Returns name, default and description of an option; positional ones are called as in `--help`."""
    annotation = ast.unparse(line.annotation)
    meaning = " ".join(description.split())
    if "Positional[" not in annotation:
        return f"`--{line.target.id.replace('_', '-')}`", {"True": "yes", "False": "no"}.get(default, default), meaning
    named = re.search(r"metavar='([^']+)'", annotation)
    name = named.group(1).replace("|", "\\|") if named else line.target.id.upper()
    return name, "required" if default in ("set by the preset", ".") else default, meaning


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
