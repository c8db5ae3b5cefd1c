"""Draws the pipelines of methods.md: python docs/make_drawings.py."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

IMAGES = Path(__file__).with_name("images")
# Steps in the order of the data, those of a network behind a star; `|` begins the second line of a box.
PIPELINES = {
    "pipeline_deepmapping": """
        planar scans|(n, b, 2) > start|odometry, ICP, search > *L-Net|poses of windows > *M-Net|occupancy, free poses
        > refinement|loops, lines > choice|poses, verdict""",
    "pipeline_register": """
        two scans|(n, 3) > pyramid|neighbours > *encoder|256 descriptors > *decoder|matches, offsets
        > consensus|up to 24 motions > verification|surfaces, free space > regression|probability""",
    "pipeline_slam": """
        scan|(n, 3) > surface|elements > odometry|local map > *network|where odometry fails > keyframe|compact scan
        > *loops|similar keyframes > pose graph|all poses""",
}


def draw(pipeline: str) -> Figure:
    """Returns a row of boxes and arrows."""
    steps = [step.strip() for step in pipeline.split(">")]
    figure = Figure(figsize=(1.7 * len(steps), 1.1))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-0.5, len(steps) - 0.5), ylim=(-1, 1))
    axes.axis("off")
    for column, step in enumerate(steps):
        color = "#cfe0f3" if step.startswith("*") else "white"
        box = {"boxstyle": "round,pad=0.5", "facecolor": color, "edgecolor": "#1f4e8c"}
        axes.text(column, 0, step.lstrip("*").replace("|", "\n"), ha="center", va="center", bbox=box, fontsize=8)
        if column:
            arrow = {"arrowstyle": "->", "color": "#555555"}
            axes.annotate("", (column - 0.43, 0), (column - 0.57, 0), arrowprops=arrow)
    return figure


def main() -> None:
    """Writes one picture for each pipeline."""
    mpl.rcParams["svg.hashsalt"] = "dpmjax"
    for name, pipeline in PIPELINES.items():
        draw(pipeline).savefig(IMAGES / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
