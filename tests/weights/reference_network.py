"""DeepPointMap's published network and losses in slow, plain NumPy with 64 bits: the oracle of the parity tests.

It reads tensors by the names of the published checkpoints, and is written from the paper (sections 3.1 to 3.3) and the
published configuration. Points are rows, channels columns. Nothing of the library is used.
"""

from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
Tensors = dict[str, Array]
TEMPERATURE, NUM_HEADS = 0.1, 8


class Stage(NamedTuple):
    """One stage of the encoder: number of points, radius of each block (normalised), number of neighbours."""

    num_points: int
    radii: tuple[float, ...]
    num_neighbours: int


class Cloud(NamedTuple):
    """Descriptors: positions in metres and features."""

    positions: Array
    features: Array


class Network(NamedTuple):
    """Tensors of the encoder and of the decoder by their published names, and the sampling of the encoder."""

    encoder: Tensors
    decoder: Tensors
    stages: tuple[Stage, ...]
    num_upsamplers: int
    scale_m: float


def linear(tensors: Tensors, name: str, x: Array) -> Array:
    weight = tensors[f"{name}.weight"].astype(np.float64)
    return x @ weight.reshape(weight.shape[:2]).T + tensors[f"{name}.bias"]


def norm(tensors: Tensors, name: str, x: Array) -> Array:
    centred = x - x.mean(axis=-1, keepdims=True)
    variance = (centred**2).mean(axis=-1, keepdims=True)
    return centred / np.sqrt(variance + 1e-5) * tensors[f"{name}.weight"] + tensors[f"{name}.bias"]


def relu(x: Array) -> Array:
    return np.maximum(x, 0)


def two_layers(tensors: Tensors, name: str, x: Array) -> Array:
    return linear(tensors, f"{name}.2", relu(linear(tensors, f"{name}.0", x)))


def softmax(x: Array, axis: int) -> Array:
    shares = np.exp(x - x.max(axis=axis, keepdims=True))
    return shares / shares.sum(axis=axis, keepdims=True)


def distances(a: Array, b: Array) -> Array:
    return np.sqrt(((a[:, None] - b) ** 2).sum(axis=-1))


def farthest_points(points: Array, count: int) -> Array:
    """Rows of points, each the farthest from those before it; the first point is the first one."""
    chosen, nearest = [0], distances(points[:1], points)[0]
    while len(chosen) < min(count, len(points)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, distances(points[chosen[-1:]], points)[0])
    return np.array(chosen)


def grouped(
    tensors: Tensors, name: str, features: Array, points: Array, centres: Array, area: tuple[int, float]
) -> Array:
    """The maximum over the nearest neighbours (number, radius); one beyond the radius is replaced by the nearest."""
    (number, radius), apart = area, distances(centres, points)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :number]
    # Points of a grid lie exactly on the sphere: rounding must not decide.
    is_far = np.take_along_axis(apart, nearest, axis=1) > radius * (1 + 1e-6)
    nearest = np.where(is_far, nearest[:, :1], nearest)
    pairs = np.concatenate([features[nearest], (points[nearest] - centres[:, None]) / radius], axis=-1)
    return relu(norm(tensors, f"{name}.1.ln", linear(tensors, f"{name}.0", pairs))).max(axis=1)


def encode(network: Network, points: Array) -> Cloud:
    """Encodes normalised points (DeepPointMap section 3.1, after PointNeXt)."""
    tensors = network.encoder
    levels = [(points.astype(np.float64), linear(tensors, "point_mlp0", points.astype(np.float64)))]
    for s, stage in enumerate(network.stages):
        (finer, features), number = levels[-1], stage.num_neighbours
        centres = finer[farthest_points(finer, stage.num_points)]
        x = grouped(tensors, f"downsampler.{s}.sa.mlp", features, finer, centres, (number, stage.radii[0]))
        for b, radius in enumerate(stage.radii[1:]):
            name = f"downsampler.{s}.irm.{b}"
            mixed = grouped(tensors, f"{name}.la.mlp", x, centres, centres, (number, radius))
            wide = relu(norm(tensors, f"{name}.pw_conv.1.ln", linear(tensors, f"{name}.pw_conv.0", mixed)))
            x = relu(norm(tensors, f"{name}.pw_conv.4.ln", linear(tensors, f"{name}.pw_conv.3", wide)) + x)
        levels.append((centres, x))
    coarse, x = levels.pop()
    for u in range(network.num_upsamplers):
        fine, features = levels.pop()
        apart = distances(fine, coarse)
        nearest = np.argsort(apart, axis=1, kind="stable")[:, :3]
        shares = 1 / (np.take_along_axis(apart, nearest, axis=1) ** 2 + 1e-8)
        shares /= shares.sum(axis=1, keepdims=True)
        x = np.concatenate([features, (shares[:, :, None] * x[nearest]).sum(axis=1)], axis=1)
        for layer in (0, 3):
            name = f"upsampler.{u}.mlp.{layer}"
            x = relu(norm(tensors, f"upsampler.{u}.mlp.{layer + 1}.ln", linear(tensors, name, x)))
        coarse = fine
    return Cloud(coarse * network.scale_m, x)


def embed(positions: Array, num_channels: int) -> Array:
    """Sines and cosines of the metric positions, axis by axis; the remaining channels are zero."""
    per_axis = num_channels // 6 * 2
    frequencies = np.pi / 10_000 ** (2 * np.arange(per_axis // 2) / per_axis)
    embedding = np.zeros((len(positions), num_channels))
    for axis in range(3):
        angles = positions[:, axis, None] * frequencies
        part = embedding[:, axis * per_axis : (axis + 1) * per_axis]
        part[:, 0::2], part[:, 1::2] = np.sin(angles), np.cos(angles)
    return embedding


def attention(tensors: Tensors, name: str, queries: Array, others: Array) -> Array:
    """Attention with eight heads, of the rows of one cloud to the rows of another."""
    width = queries.shape[1]
    weight, bias = tensors[f"{name}.in_proj_weight"].astype(np.float64), tensors[f"{name}.in_proj_bias"]
    parts = [slice(k * width, (k + 1) * width) for k in range(3)]
    q, k, v = (x @ weight[part].T + bias[part] for x, part in zip((queries, others, others), parts, strict=True))
    size, mixed = width // NUM_HEADS, np.zeros_like(queries)
    for head in range(NUM_HEADS):
        of_head = slice(head * size, (head + 1) * size)
        mixed[:, of_head] = softmax(q[:, of_head] @ k[:, of_head].T / np.sqrt(size), axis=1) @ v[:, of_head]
    return linear(tensors, f"{name}.out_proj", mixed)


def correlate(network: Network, *clouds: Cloud) -> list[Array]:
    """Features of two clouds after the attention layers (section 3.2)."""
    tensors = network.decoder
    x = [linear(tensors, "projection", cloud.features) for cloud in clouds]
    embeddings = [embed(cloud.positions, x[0].shape[1]) for cloud in clouds]
    num_layers = len({name.split(".")[1] for name in tensors if name.startswith("descriptor_attention")})
    for layer in range(num_layers):
        name = f"descriptor_attention.{layer}"
        x = [a + e for a, e in zip(x, embeddings, strict=True)]
        x = [norm(tensors, f"{name}.norm1", a + attention(tensors, f"{name}.self_attn", a, a)) for a in x]
        x = [a + e for a, e in zip(x, embeddings, strict=True)]
        crossed = zip(x, x[::-1], strict=True)
        x = [norm(tensors, f"{name}.norm2", a + attention(tensors, f"{name}.cross_attn", a, b)) for a, b in crossed]
        x = [norm(tensors, f"{name}.norm3", a + two_layers(tensors, f"{name}.mlp", a)) for a in x]
    return x


def cosines(a: Array, b: Array) -> Array:
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    return a @ b.T


def similarity(network: Network, a: Array, b: Array) -> Array:
    return cosines(*(two_layers(network.decoder, "similarity_head", x) for x in (a, b)))


def overlap_probability(network: Network, a: Array, b: Array) -> float:
    means = [two_layers(network.decoder, "loop_head.mlp", x).mean(axis=0) for x in (a, b)]
    return float(1 / (1 + np.exp(-two_layers(network.decoder, "loop_head.projection", np.concatenate(means))[0])))


def offsets(network: Network, features: Array, partners: Array) -> Array:
    tensors = network.decoder
    x = pair = np.concatenate([features, partners], axis=-1)
    x = relu(linear(tensors, "offset_head.mlp.0", x))
    x = relu(linear(tensors, "offset_head.mlp.2", x))
    x = linear(tensors, "offset_head.mlp.4", x) + linear(tensors, "offset_head.downsample", pair)
    return linear(tensors, "offset_head.head", relu(x))


class Match(NamedTuple):
    """A registration: motion of the source into the target, rms error of the inliers, scores of the inliers."""

    R: Array
    t: Array
    rmse: float
    inlier_scores: Array


def kabsch(source: Array, target: Array, weights: Array) -> tuple[Array, Array]:
    shares = weights / weights.sum()
    centre_a, centre_b = shares @ source, shares @ target
    U, _, Vt = np.linalg.svd((shares[:, None] * (source - centre_a)).T @ (target - centre_b))
    R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
    return R, centre_b - R @ centre_a


def register(network: Network, a: Cloud, b: Cloud) -> Match:
    """Registers two clouds: dual softmax, best pairs, offsets both ways, weighted SVD in rounds (eq. 1 to 3)."""
    x, y = correlate(network, a, b)
    cosine = similarity(network, x, y) / TEMPERATURE
    scores = (softmax(cosine, 0) * softmax(cosine, 1)).ravel()
    best = np.argsort(-scores, kind="stable")[: (len(x) + len(y)) // 2 // 2]
    rows, columns = best // len(y), best % len(y)
    forward, backward = offsets(network, x[rows], y[columns]), offsets(network, y[columns], x[rows])
    source = np.concatenate([a.positions[rows] + forward, a.positions[rows]])
    target = np.concatenate([b.positions[columns], b.positions[columns] + backward])
    is_used = np.linalg.norm(np.concatenate([forward, backward]), axis=1) <= 2
    source, target, weights = source[is_used], target[is_used], np.tile(scores[best], 2)[is_used]
    ranks = np.argsort(np.argsort(-weights, kind="stable"))
    inlier = (weights > 0.5) | (ranks < 64)
    for _ in range(3):
        R, t = kabsch(source[inlier], target[inlier], weights[inlier])
        errors = np.linalg.norm(source @ R.T + t - target, axis=1)
        chosen = errors <= errors[inlier].mean() + 3 * errors[inlier].std()
        inlier = chosen if chosen.sum() >= 30 else inlier
    R, t = kabsch(source[inlier], target[inlier], weights[inlier])
    errors = np.linalg.norm(source @ R.T + t - target, axis=1)[inlier]
    return Match(R, t, float(np.sqrt((errors**2).mean())), weights[inlier])


def losses(network: Network, a: Cloud, b: Cloud, T_b_a: Array) -> dict[str, float]:
    """Pairing, coarse pairing and offset loss, top-1 accuracy: means of both directions (eq. 4 to 7)."""
    correlated = correlate(network, a, b)
    moved = a.positions @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    apart = distances(moved, b.positions)
    ways: list[dict[str, float]] = []
    for (here, there), near, turn in (((0, 1), apart, T_b_a[:3, :3].T), ((1, 0), apart.T, np.eye(3))):
        clouds = (a, b)
        matched = [two_layers(network.decoder, "similarity_head", correlated[k]) for k in (here, there)]
        coarse = [two_layers(network.decoder, "coarse_pairing_head", clouds[k].features) for k in (here, there)]
        rows = np.flatnonzero(near.min(axis=1) <= 1)
        positive = near.argmin(axis=1)[rows]
        neutral = (near[rows] <= 1) & (np.arange(near.shape[1]) != positive[:, None])
        i, j = np.nonzero(near <= 2)
        # The true offset from a descriptor to its partner, in the frame of the descriptor.
        ends = (moved, b.positions) if here == 0 else (b.positions, moved)
        true = (ends[1][j] - ends[0][i]) @ turn.T
        error = offsets(network, correlated[here][i], correlated[there][j]) - true
        inverse = np.linalg.inv(np.cov(error.T))
        cosine = cosines(*matched)[rows]
        ways.append(
            {
                "pairing": info_nce(cosine, positive, np.zeros_like(neutral)),
                "coarse": info_nce(cosines(*coarse)[rows], positive, neutral),
                "offset": float(np.sqrt(np.einsum("ni,ij,nj->n", error, inverse, error)).mean()),
                "top1_accuracy": float((cosine.argmax(axis=1) == positive).mean()),
            }
        )
    terms = {name: (ways[0][name] + ways[1][name]) / 2 for name in ways[0]}
    return terms | {"total": terms["pairing"] + 0.1 * terms["coarse"] + terms["offset"]}


def info_nce(cosine: Array, positive: Array, ignored: Array) -> float:
    logits = np.where(ignored, -np.inf, cosine / TEMPERATURE)
    largest = logits.max(axis=1)
    total = largest + np.log(np.exp(logits - largest[:, None]).sum(axis=1))
    return float((total - logits[np.arange(len(positive)), positive]).mean())


def network_of(checkpoint: dict[str, Any], encoder: dict[str, Any], scale_m: float) -> Network:
    """A network of a checkpoint and its published configuration."""
    lists = (encoder[key] for key in ("npoint", "radius_list", "nsample_list"))
    stages = tuple(Stage(count, tuple(radii), numbers[0]) for count, radii, numbers in zip(*lists, strict=True))
    parts = ({name: np.asarray(x) for name, x in checkpoint[part].items()} for part in ("encoder", "decoder"))
    return Network(*parts, stages, encoder["upsample_layers"], scale_m)
