"""Calibrates a DeepPointMap model on towns that it was not trained on: its confidence, and its overlap probability.

    python -m experiments.dpm_calibrate results/train/latest/model.safetensors

Pairs of scans of held-out towns, overlapping and not, are registered. A logistic regression then predicts whether the
motion is right within 2 m and 5 degrees. Its few features include the consensus support, the share of points that meet
surfaces and the share of points in free space. Pairs whose walls hold one direction only have a regression of their
own, on two features, and so have matches of clouds of surface elements, without the scans. Ambiguous places add pairs:
corridors, tunnels, halls, open fields and streets with queues of moving cars, by lidars of 16, 32 and 64 beams. Overlap
is another regression, on the evidence of the match (similarities of descriptors, consensus support ...) of pairs of
further towns, half of them less than 20 m apart. Results go to results/dpm_calibrate/<time>/: model.safetensors,
metrics.json, reliability.png, reliability_clouds.png and reliability_overlap.png. The file model.safetensors is the
model with all regressions. The file metrics.json has the Brier scores, the calibration errors, and the AUC of overlap,
of places that were left out of the fits. `python -m experiments.dpm_confidence` checks the confidence on other places.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import DescriptorCloud, cli, encode, load_model, metrics, save_model, simulation, slam, viz
from dpmjax import deeppointmap as dpm
from dpmjax.io import LidarSequence
from dpmjax.weights import read_card

# Smallest and largest distance of the pairs of each kind, metres.
Bands = tuple[tuple[float, float], ...]
# Probabilities of examples by fits without their place, and the labels of these examples.
HeldOut = tuple[np.ndarray, np.ndarray]

EXPERIMENT = "dpm_calibrate"
MODEL = "model.safetensors"
AMBIGUOUS = ("corridor", "tunnel", "jam", "hall", "field")
BEAMS = {16: simulation.VLP16, 32: simulation.HDL32E, 64: simulation.OS1_64}
KINDS = ("of_clouds", "of_elements", "of_scans", "of_weak_scans")
OF_CLOUDS = ("of_clouds", "of_elements")
HAVE_LOOKALIKES = ("of_elements", "of_scans")
# Elements of a scan in the map of SLAM, and in `register(..., refine=True)` with a cloud.
NUM_ELEMENTS = 1024
PAIR_STREAM = 4141
# Scans of each town, and of another town beside, that pairs are made of.
NUM_SCANS, NUM_OTHER_SCANS = 36, 12
TOWN_STREAM = 4134
OVERLAP_LABELS = ("overlap probability", "share of overlapping pairs")
TOWN_BANDS_M = ((2.0, 10.0), (10.0, 20.0), (60.0, np.inf))
# The two ends of a corridor may look alike. Only `register` of clouds has to know: SLAM proposes neighbours, and scans
# tell the ends apart.
FAR_M = 60.0
AMBIGUOUS_BANDS_M = ((1.0, 10.0), (10.0, 20.0), (FAR_M, np.inf))
# Far from the seeds of the towns of training, also of its held-out one.
FIRST_TOWN, FIRST_AMBIGUOUS, FIRST_OVERLAP_TOWN = 3_000_000, 3_100_000, 3_500_000
TOWN_LENGTH_M = 400.0
# The kinds of town, of which there are nine, and of ambiguous place take turns, so that each counts the same.
NUM_TOWNS, NUM_AMBIGUOUS, NUM_OVERLAP_TOWNS = 9, 30, 24
# Pairs of each band of a place, and of each town of the overlap.
NUM_PAIRS, NUM_OVERLAP_PAIRS = 30, 96


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the run."""

    model: Annotated[Positional[str], arg(metavar="NAME|FILE")] = "dpm_small"
    """The model: a .safetensors file, or the name of a shipped one."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, seed=0)


def main(config: Config) -> list[cli.Row]:
    """Registers and compares the pairs, fits, and writes the model."""
    model = load_model(config.model)

    def work(run: cli.TableRun, **case: int | str) -> cli.Row:
        if "overlap_town" in case:
            # The other town is that of the next row.
            seeds = (case["overlap_town"], case["overlap_town"] + 1)
            drives = [simulation.simulate_drive(seed, length_m=TOWN_LENGTH_M) for seed in seeds]
            return measure_town(model, drives, NUM_OVERLAP_PAIRS, config.seed)
        drive, bands_m = open_place(**case)
        return measure_pairs(model, run.until_stopped(draw_pairs(drive, bands_m, NUM_PAIRS, config.seed)))

    cases = list_cases()
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: report(config, model, rows, len(cases)))


def list_cases() -> list[cli.Row]:
    """Returns the places of the confidence, then the towns of the overlap."""
    kinds = itertools.cycle(kind for kind, _ in simulation.SceneMixture().kinds)
    towns = [{"town": FIRST_TOWN + number, "kind": next(kinds)} for number in range(NUM_TOWNS)]
    places = [ambiguous_case(number, FIRST_AMBIGUOUS) for number in range(NUM_AMBIGUOUS)]
    return towns + places + [{"overlap_town": FIRST_OVERLAP_TOWN + number} for number in range(NUM_OVERLAP_TOWNS)]


def open_place(*, kind: str, town: int | None = None, place: int = 0, beams: int = 0) -> tuple[LidarSequence, Bands]:
    """Simulates a town or an ambiguous place; returns its drive, and the distances of its pairs, metres."""
    if town is not None:
        return simulation.simulate_drive(town, length_m=TOWN_LENGTH_M, kind=kind), TOWN_BANDS_M
    return ambiguous_drive(place, kind, beams), AMBIGUOUS_BANDS_M


def report(config: Config, model: dpm.Model, rows: list[cli.Row], num_cases: int) -> cli.Summary:
    """Fits the regressions; the model and the reliability of places left out are written with the pictures."""
    if len(rows) < num_cases:
        return cli.Summary({"model": config.model}, f"{len(rows)} of {num_cases} places", rows=())
    calibration, numbers, held_out = fit([row for row in rows if "overlap_town" not in row])
    overlap, overlap_numbers, overlap_held_out = fit_overlap([row for row in rows if "overlap_town" in row])
    numbers |= overlap_numbers
    calibrated = replace(model.config, calibration=calibration, overlap=overlap)
    note = f"Confidence calibrated on {NUM_TOWNS} towns and {NUM_AMBIGUOUS} ambiguous places, "
    note += f"{numbers['num_pairs']} pairs"
    note += f"; overlap fitted on {NUM_OVERLAP_TOWNS} towns, {numbers['num_overlap_pairs']} pairs"
    title = "places left out of the fit"
    figures = {
        name: viz.reliability_figure(*held_out[kind], title=title)
        for kind, name in (("of_scans", "reliability.png"), ("of_elements", "reliability_clouds.png"))
    }
    figures["reliability_overlap.png"] = viz.reliability_figure(
        *overlap_held_out, title=f"overlap, {title}", labels=OVERLAP_LABELS
    )

    def write(folder: cli.RunFolder) -> None:
        card = read_card(Path(config.model)) if config.model.endswith(".safetensors") else config.model
        save_model(model.replace(config=calibrated), folder / MODEL, card=f"{card} {note}.".strip())
        for name, figure in figures.items():
            viz.save_figure(figure, folder / name)

    text = ", ".join(f"{name} {value:.3f}" for name, value in numbers.items() if isinstance(value, float))
    return cli.Summary({"model": config.model, **numbers}, text, write, rows=())


def fit(rows: list[cli.Row]) -> tuple[dpm.Calibration, cli.Row, dict[str, HeldOut]]:
    """Returns the calibration of all places, its numbers, and the confidence of each place when it is left out.

    Each model is fitted on the pairs that it rates: scans on those whose walls hold all directions.
    """
    numbers: cli.Row = {"num_pairs": sum(len(row["is_right"]) for row in rows)}
    models, held_out = {}, {}
    features_of = dpm.CLOUD_FEATURES, dpm.ELEMENT_FEATURES, dpm.SCAN_FEATURES, dpm.WEAK_FEATURES
    for kind, names in zip(KINDS, features_of, strict=True):
        pairs = [
            (
                place,
                row[kind][number],
                row["is_right_of_clouds" if kind in OF_CLOUDS else "is_right"][number],
                lookalike_gap(row, number, kind),
            )
            for place, row in enumerate(rows)
            for number, weak in enumerate(row["of_weak_scans"])
            if row[kind][number] is not None
            and (kind != "of_scans" or weak is None)
            and (kind == "of_elements" or not is_end(row, number))
        ]
        if kind == "of_weak_scans" and len({is_right for _, _, is_right, _ in pairs}) < 2:
            continue
        place, features, is_right, gaps = (np.array(column) for column in zip(*pairs, strict=True))
        models[kind], held_out[kind] = fit_held_out(names, features, is_right, place, dpm.lookalike_share(gaps))
        numbers |= {
            f"num_pairs_{kind}": len(pairs),
            f"share_right_{kind}": float(is_right.mean()),
            f"brier_{kind}": metrics.brier_score(*held_out[kind]),
            f"brier_of_a_constant_{kind}": float(is_right.var()),
            f"calibration_error_{kind}": metrics.expected_calibration_error(*held_out[kind]),
        }
    return dpm.Calibration(**models), numbers, held_out


def is_end(row: cli.Row, number: int) -> bool:
    """Returns True for a pair without overlap in an ambiguous place, whose ends may look alike."""
    return "place" in row and bool(row["distance_m"][number] >= FAR_M)


def lookalike_gap(row: cli.Row, number: int, kind: str) -> float:
    """Returns the lead of a pair over other places that look alike; files hold None for infinity."""
    gap = row["lookalike_gap_" + kind][number] if kind in HAVE_LOOKALIKES else None
    return np.inf if gap is None else float(gap)


def ambiguous_case(number: int, first_seed: int) -> cli.Row:
    """Returns the case of one of the ambiguous places: kinds of place take turns, then lidars do."""
    beams = list(BEAMS)[number // len(AMBIGUOUS) % len(BEAMS)]
    return {"place": first_seed + number, "kind": AMBIGUOUS[number % len(AMBIGUOUS)], "beams": beams}


def ambiguous_drive(place: int, kind: str, beams: int) -> LidarSequence:
    """Simulates an ambiguous place in its true size."""
    true_size = simulation.SceneMixture(indoor_scale=(1.0, 1.0))
    lidar, length_m = BEAMS[beams], TOWN_LENGTH_M
    return simulation.simulate_drive(place, length_m=length_m, kind=kind, sensor=lidar, mixture=true_size)


def draw_pairs(drive: LidarSequence, bands_m: Bands, num_pairs: int, seed: int) -> Iterator[dpm.ScanPair]:
    """Reads random pairs of each band of distances, fewer than `num_pairs` where the drive has fewer."""
    distances = dpm.scan_distances(drive)
    for number, (low, high) in enumerate(bands_m):
        drawn = dpm.draw_rows_apart(distances, low, high, num_pairs, np.random.default_rng([PAIR_STREAM, number, seed]))
        yield from dpm.read_scan_pairs(drive, drawn, seed=seed)


def measure_pairs(model: dpm.Model, pairs: Iterable[dpm.ScanPair]) -> cli.Row:
    """Registers pairs as scans, and as clouds of surface elements.

    Args:
        model: encoder and decoder.
        pairs: the pairs.

    Returns:
        Lists with an entry for each pair: the evidence of each kind, whether both registrations are right, and the
        true distance, metres.
    """
    gaps = [f"lookalike_gap_{kind}" for kind in HAVE_LOOKALIKES]
    found: cli.Row = {name: [] for name in (*KINDS, *gaps, "is_right_of_clouds", "is_right", "distance_m")}
    num_elements = min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points)
    for pair in pairs:
        result = dpm.register_in_stages(model, pair)
        clouds = [encode(model, points, num_elements=num_elements) for points in (pair.source, pair.target)]
        T_of_clouds, evidence_of_clouds = dpm.register_clouds(model, *clouds)
        motions = np.stack([T_of_clouds, result.verified])
        is_right = metrics.registration_recall(motions, np.stack([pair.T_target_source] * 2)).is_right
        for name in KINDS:
            # At run time clouds have the features of their own best motion, whatever the scans say.
            features = getattr(evidence_of_clouds if name in OF_CLOUDS else result.evidence, name)
            found[name].append(None if features is None else features.tolist())
        for name, evidence in zip(gaps, (evidence_of_clouds, result.evidence), strict=True):
            gap = float(evidence.lookalike_gap)
            found[name].append(gap if np.isfinite(gap) else None)
        found["is_right_of_clouds"].append(bool(is_right[0]))
        found["is_right"].append(bool(is_right[1]))
        found["distance_m"].append(float(np.linalg.norm(pair.T_target_source[:3, 3])))
    return found


class LabelledPairs(NamedTuple):
    """Pairs of scans; whether they are less than 20 m apart; and hard: farther apart, but similar by retrieval."""

    sources: list[DescriptorCloud]
    targets: list[DescriptorCloud]
    is_overlap: np.ndarray
    is_hard: np.ndarray


def town_pairs(model: dpm.Model, drives: Sequence[LidarSequence], num_pairs: int, seed: int) -> LabelledPairs:
    """Returns encoded pairs of a town.

    Half of the pairs are less than 20 m apart, a quarter 20 to 40 m, an eighth farther; an eighth has one scan of
    another town. A quarter more are hard: a scan, and the most similar one by retrieval that is at least 20 m away.

    Args:
        model: encoder and decoder.
        drives: drives through the town, and through a second one.
        num_pairs: number of pairs without the hard ones, about.
        seed: seed of the run.
    """
    rng = np.random.default_rng([TOWN_STREAM, seed])
    rows = [
        np.unique(np.linspace(0, len(drive) - 1, num).astype(int))
        for drive, num in zip(drives, (NUM_SCANS, NUM_OTHER_SCANS), strict=True)
    ]
    own, other = (dpm.encode_turned(model, drive, some, rng=rng) for drive, some in zip(drives, rows, strict=True))
    clouds = [cloud.described for cloud in (*own, *other)]
    distances = dpm.scan_distances(drives[0])[np.ix_(rows[0], rows[0])]
    distances = np.pad(distances, [(0, 0), (0, len(other))], constant_values=np.inf)
    kinds = (
        (distances < dpm.OVERLAP_M) & (distances > 0),
        (distances >= dpm.OVERLAP_M) & (distances < dpm.NO_OVERLAP_M),
        (distances >= dpm.NO_OVERLAP_M) & (distances < np.inf),
        distances == np.inf,
    )
    shares = (2, 4, 8, 8)
    drawn = [dpm.draw_rows(np.argwhere(kind), num_pairs // n, rng) for kind, n in zip(kinds, shares, strict=True)]
    vectors = np.stack([slam.pooled_vector(cloud) for cloud in clouds])
    hard = [
        (row, int(similar[0]))
        for row in range(len(own))
        if len(similar := slam.most_similar(vectors, vectors[row], 1, is_allowed=distances[row] >= dpm.OVERLAP_M)[0])
    ]
    drawn.append(dpm.draw_rows(np.array(hard, int).reshape(-1, 2), num_pairs // 4, rng))
    pairs = np.concatenate(drawn)
    sources, targets = ([clouds[row] for row in side] for side in pairs.T)
    is_hard = np.arange(len(pairs)) >= len(pairs) - len(drawn[-1])
    return LabelledPairs(sources, targets, distances[tuple(pairs.T)] < dpm.OVERLAP_M, is_hard)


def measure_town(model: dpm.Model, drives: Sequence[LidarSequence], num_pairs: int, seed: int) -> cli.Row:
    """Returns evidence and labels of the pairs of a town, without the hard ones; see `town_pairs`."""
    pairs = town_pairs(model, drives, num_pairs, seed)
    num = int(np.sum(~pairs.is_hard))
    evidence = np.asarray(dpm.evidence_pairs(model, pairs.sources[:num], pairs.targets[:num]))
    return {"evidence": evidence.tolist(), "is_overlap": pairs.is_overlap[:num].tolist()}


def fit_overlap(rows: Sequence[cli.Row]) -> tuple[dpm.LogisticModel, cli.Row, HeldOut]:
    """Returns the model of overlap, its numbers, and the probability of the pairs of each town when it is left out."""
    towns = np.concatenate([np.full(len(row["is_overlap"]), row["overlap_town"]) for row in rows])
    features = np.concatenate([np.asarray(row["evidence"], float) for row in rows])
    is_overlap = np.concatenate([np.asarray(row["is_overlap"], bool) for row in rows])
    fitted, found = fit_held_out(dpm.OVERLAP_FEATURES, features, is_overlap, towns, np.ones(len(towns)))
    numbers = {
        "num_overlap_pairs": len(towns),
        "auc_overlap": metrics.area_under_curve(*found),
        "brier_overlap": metrics.brier_score(*found),
        "brier_of_a_constant_overlap": float(is_overlap.var()),
    }
    return fitted, numbers, found


def fit_held_out(
    names: tuple[str, ...],
    features: np.ndarray,
    labels: np.ndarray,
    places: np.ndarray,
    shares: np.ndarray,
) -> tuple[dpm.LogisticModel, HeldOut]:
    """Returns the regression on all places, and the probability of each example by a fit on all places but its own."""
    found = np.empty(len(places))
    for place in np.unique(places):
        part = places == place
        fitted = dpm.fit_logistic(names, features[~part], labels[~part], shares[~part])
        found[part] = shares[part] * dpm.logistic_probability(fitted, features[part])
    return dpm.fit_logistic(names, features, labels, shares), (found, labels)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
