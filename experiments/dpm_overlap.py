"""Compares predictions of overlap: the head of the decoder, untrained and trained, and logistic regressions.

    python -m experiments.dpm_overlap dpm_small path/to/drive another/drive

The parameters of encoder and decoder do not change. The overlap head (DeepPointMap section 3.2) is trained on the
correlated features of pairs of simulated towns. A fifth of the pairs is hard: retrieval finds the scans most similar,
although they are at least 20 m apart. Every fifth town decides when the training stops, and scales the logit (Platt
1999). The regressions see the evidence of the match, with random pairs alone, with hard ones, and with the logit of the
trained head. All are compared on further towns and on recorded drives, below 20 m against above 40 m. A drive without
pairs that far apart is compared with scans of the next drive. Results go to results/dpm_overlap/<time>/: table.md,
metrics.json.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.special import expit
from tyro.conf import Positional, arg

from dpmjax import DescriptorCloud, cli, io, load_model, metrics, simulation
from dpmjax import deeppointmap as dpm
from dpmjax.nets import DescriptorDecoder
from experiments import dpm_calibrate as calibrate

EXPERIMENT = "dpm_overlap"
FIRST_OTHER_TOWN = 3_600_000
# Towns that are trained and fitted on, and towns that are compared on.
NUM_TOWNS, NUM_OTHER_TOWNS = 24, 9
# Pairs of each kind of a recorded drive.
NUM_PAIRS = 120
# Every such town stops the training of the head and scales its logit.
HELD_OUT_STRIDE = 5
NUM_EPOCHS, BATCH, LEARNING_RATE, WEIGHT_DECAY = 30, 32, 1e-3, 1e-2
# The head averages over descriptors: a quarter of them, drawn for each step, trains it at a quarter of the cost.
NUM_DRAWN = 64


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the run."""

    model: Annotated[Positional[str], arg(metavar="NAME|FILE")]
    """The model: a .safetensors file, or the name of a shipped one."""
    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="PATH ...")] = ()
    """Folders of scans with poses."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, seed=0)


class Examples(NamedTuple):
    """Pairs of scans: evidence (p, f), correlated features (p, 2, n, c) and masks (p, 2, n) of both sides, labels."""

    evidence: np.ndarray
    features: np.ndarray
    mask: np.ndarray
    is_overlap: np.ndarray
    is_hard: np.ndarray

    def at(self, rows: np.ndarray) -> Examples:
        """Returns some of the pairs."""
        return Examples(*(column[rows] for column in self))


def main(config: Config) -> list[cli.Row]:
    """Measures all pairs, trains, fits and compares."""
    model = load_model(config.model)
    drives = cli.open_evaluation_drives(config.paths, [])
    if len(drives) == 1 and not len(dpm.overlap_candidates(drives[0])[1]):
        raise ValueError(f"{drives[0].name}: no scans are 40 m apart; give a second drive for pairs without overlap")

    def work(run: cli.TableRun) -> cli.Row:
        fitted = measure_towns(model, calibrate.FIRST_OVERLAP_TOWN, NUM_TOWNS, config.seed, run)
        other = measure_towns(model, FIRST_OTHER_TOWN, NUM_OTHER_TOWNS, config.seed, run)
        places = {"towns": joined([town.at(~town.is_hard) for town in other]), "towns, hard pairs too": joined(other)}
        for drive, following in run.until_stopped(zip(drives, drives[1:] + drives[:1], strict=True)):
            places[drive.name] = measure_drive(model, drive, following, config.seed)
        return {"compared": compare(model, fitted, places, config.seed)}

    def report(rows: list[cli.Row]) -> cli.Summary:
        compared = [{**row, "git_hash": rows[0].get("git_hash")} for row in rows[0]["compared"]]
        return cli.Summary({"model": config.model}, table(compared), rows=compared)

    return cli.run_table(config, EXPERIMENT, [{}], work, report)


def measure_towns(model: dpm.Model, first: int, num_towns: int, seed: int, run: cli.TableRun) -> list[Examples]:
    """Returns the pairs of each town; the next town gives scans of another place."""
    seeds = range(first, first + num_towns + 1)
    drives = (simulation.simulate_drive(town, length_m=calibrate.TOWN_LENGTH_M) for town in seeds)
    pairs = (
        calibrate.town_pairs(model, both, calibrate.NUM_OVERLAP_PAIRS, seed) for both in itertools.pairwise(drives)
    )
    return [measure(model, of_town) for of_town in run.until_stopped(pairs)]


def measure_drive(model: dpm.Model, drive: io.LidarSequence, following: io.LidarSequence, seed: int) -> Examples:
    """Returns pairs of a recorded drive."""
    near, far, _ = dpm.overlap_candidates(drive)
    rng = np.random.default_rng([calibrate.TOWN_STREAM, seed])
    near, far = (dpm.draw_rows(rows, NUM_PAIRS, rng) for rows in (near, far))
    num_far = len(far) or len(near)
    pairs = np.concatenate([near, far if len(far) else rng.integers(len(drive), size=(num_far, 1)).repeat(2, axis=1)])
    rows, places = np.unique(pairs, return_inverse=True)
    clouds = [cloud.described for cloud in dpm.encode_turned(model, drive, rows, rng=rng)]
    sources, targets = ([clouds[place] for place in side] for side in places.reshape(pairs.shape).T)
    if not len(far):
        others = dpm.encode_turned(model, following, rng.integers(len(following), size=min(num_far, 20)), rng=rng)
        targets[len(near) :] = [others[number % len(others)].described for number in range(num_far)]
    is_overlap = np.arange(len(pairs)) < len(near)
    return measure(model, calibrate.LabelledPairs(sources, targets, is_overlap, np.zeros(len(pairs), bool)))


def measure(model: dpm.Model, pairs: calibrate.LabelledPairs) -> Examples:
    """Matches pairs; float16 halves the correlated features in memory."""
    sources, targets, is_overlap, is_hard = pairs
    correlated = [jax.device_get(dpm.correlate(model, *pair)) for pair in zip(sources, targets, strict=True)]
    features = np.stack([[cloud.features.astype(np.float16) for cloud in pair] for pair in correlated])
    mask = np.stack([[cloud.mask for cloud in pair] for pair in correlated])
    evidence = np.asarray(dpm.evidence_pairs(model, sources, targets), float)
    return Examples(evidence, features, mask, is_overlap, is_hard)


def joined(parts: Sequence[Examples]) -> Examples:
    """Joins the pairs of several places."""
    return Examples(*map(np.concatenate, zip(*parts, strict=True)))


def compare(model: dpm.Model, towns: list[Examples], places: dict[str, Examples], seed: int) -> list[cli.Row]:
    """Returns a row for each method and place."""
    stopping = joined(towns[::HELD_OUT_STRIDE])
    training = joined([town for number, town in enumerate(towns) if number % HELD_OUT_STRIDE])
    everything = joined(towns)
    untrained = model.params["decoder"]["overlap_head"]
    trained = train_head(model, training, stopping, seed)
    scale, bias = dpm.fit_weights(head_logits(model, trained, stopping)[:, None], stopping.is_overlap)

    def of_head(head: Any, scale: float, bias: float) -> Callable[[Examples], np.ndarray]:
        return lambda pairs: expit(scale * head_logits(model, head, pairs) + bias)

    def regression(pairs: Examples, features: Callable[[Examples], np.ndarray]) -> Callable[[Examples], np.ndarray]:
        weights, bias = dpm.fit_weights(features(pairs), pairs.is_overlap)
        return lambda other: expit(features(other) @ weights + bias)

    def with_logit(pairs: Examples) -> np.ndarray:
        return np.column_stack([pairs.evidence, head_logits(model, trained, pairs)])

    methods = {
        "head, untrained": of_head(untrained, 1.0, 0.0),
        "head, trained": of_head(trained, float(scale[0]), bias),
        "regression": regression(everything.at(~everything.is_hard), lambda pairs: pairs.evidence),
        "regression, hard pairs": regression(everything, lambda pairs: pairs.evidence),
        # The head fits its training pairs: a regression on them would rely on its logit too much.
        "regression, logit of the head": regression(stopping, with_logit),
    }
    shipped = model.config.overlap
    if shipped is not None:
        methods["as shipped"] = lambda pairs: dpm.logistic_probability(shipped, pairs.evidence)
    rows = []
    for method, probability in methods.items():
        for place, pairs in places.items():
            found = probability(pairs), pairs.is_overlap
            values = {
                "auc": metrics.area_under_curve(*found),
                "brier": metrics.brier_score(*found),
                "expected_calibration_error": metrics.expected_calibration_error(*found),
            }
            rows.append({"method": method, "place": place, "num_pairs": len(pairs.is_overlap), **values})
    return rows


def train_head(model: dpm.Model, training: Examples, stopping: Examples, seed: int) -> Any:
    """Trains the overlap head alone by binary cross entropy; returns its parameters where other towns are best."""
    rng = np.random.default_rng(seed)
    num_steps = NUM_EPOCHS * max(len(training.is_overlap) // BATCH, 1)
    optimizer = optax.adamw(optax.cosine_decay_schedule(LEARNING_RATE, num_steps), weight_decay=WEIGHT_DECAY)

    @jax.jit
    def step(head: Any, state: Any, features: jax.Array, mask: jax.Array, labels: jax.Array) -> tuple[Any, Any]:
        def loss(head: Any) -> jax.Array:
            return optax.sigmoid_binary_cross_entropy(_logits(model, head, features, mask), labels).mean()

        updates, state = optimizer.update(jax.grad(loss)(head), state, head)
        return optax.apply_updates(head, updates), state

    head = dpm.init_model(jax.random.key(seed), model.config).params["decoder"]["overlap_head"]
    state, best, lowest = optimizer.init(head), head, np.inf
    for _ in range(NUM_EPOCHS):
        order = rng.permutation(len(training.is_overlap))
        for start in range(0, max(len(order) - BATCH, 0) + 1, BATCH):
            rows = order[start : start + BATCH]
            drawn = rng.choice(training.mask.shape[2], min(NUM_DRAWN, training.mask.shape[2]), replace=False)
            # Either scan may be the first.
            sides = rng.permutation(2)
            features, mask = (column[np.ix_(rows, sides, drawn)] for column in (training.features, training.mask))
            head, state = step(head, state, features, mask, training.is_overlap[rows].astype(np.float32))
        logits = head_logits(model, head, stopping)
        loss = np.logaddexp(0, np.where(stopping.is_overlap, -logits, logits)).mean()
        if loss < lowest:
            best, lowest = head, loss
    return best


def head_logits(model: dpm.Model, head: Any, pairs: Examples) -> np.ndarray:
    """Returns the logit of the head for each pair."""
    starts = range(0, len(pairs.mask), BATCH)
    parts = [_logits(model, head, *(c[s : s + BATCH] for c in (pairs.features, pairs.mask))) for s in starts]
    return np.concatenate([np.asarray(part, float) for part in parts])


@jax.jit
def _logits(model: dpm.Model, head: Any, features: jax.Array, mask: jax.Array) -> Any:
    decoder = DescriptorDecoder(model.config.decoder)
    params = {**model.params["decoder"], "overlap_head": head}

    def one(features: jax.Array, mask: jax.Array) -> Any:
        features = features.astype(jnp.float32)
        a, b = (DescriptorCloud(jnp.zeros((mask.shape[1], 3)), features[side], mask[side]) for side in (0, 1))
        return decoder.apply({"params": params}, a, b, method="overlap_logit")

    return jax.vmap(one)(features, mask)


def table(rows: Sequence[cli.Row]) -> str:
    """Returns AUC, Brier score and expected calibration error of each method, a column for each place."""
    places = list(dict.fromkeys(row["place"] for row in rows))
    names = ("auc", "brier", "expected_calibration_error")
    cells = {(row["method"], row["place"]): " / ".join(cli.cell_text(row[name], 3) for name in names) for row in rows}
    methods = dict.fromkeys(row["method"] for row in rows)
    lines = [[method, *(cells[method, place] for place in places)] for method in methods]
    return cli.markdown(("AUC / Brier score / expected calibration error", *places), lines)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
