"""Kernels inside your own JAX program: jit, vmap and grad of the weighted SVD, InfoNCE and ICP."""

import jax
import jax.numpy as jnp

import dpmjax

points_key, noise_key, turn_key = jax.random.split(jax.random.key(0), 3)
source = jax.random.uniform(points_key, (200, 2), minval=-5.0, maxval=5.0)


def moved(turn):
    """Returns the source points turned by an angle and shifted by (0.1, 0.2)."""
    R = jnp.array([[jnp.cos(turn), -jnp.sin(turn)], [jnp.sin(turn), jnp.cos(turn)]])
    return source @ R.T + jnp.array([0.1, 0.2])


# grad: how the best rigid motion depends on the weights of the pairs.
target = moved(0.03) + 0.02 * jax.random.normal(noise_key, source.shape)
shift = jax.grad(lambda weights: dpmjax.weighted_svd(source, target, weights)[0, 2])(jnp.ones(200))
print("d shift / d weights:", shift.shape, bool(jnp.isfinite(shift).all()))

# vmap and jit: eight targets are aligned side by side, and a second call compiles nothing.
turns = jax.random.uniform(turn_key, (8,), minval=-0.05, maxval=0.05)
align = jax.jit(jax.vmap(lambda turn: dpmjax.icp(source, moved(turn), metric="point").T_target_source))
T = align(turns)
print("largest error of eight turns, rad:", float(jnp.abs(jnp.arctan2(T[:, 1, 0], T[:, 0, 0]) - turns).max()))

# A loss for descriptors, and its gradient, with the rows that count given by a mask.
queries, keys = jax.random.normal(points_key, (64, 32)), jax.random.normal(noise_key, (80, 32))
mask = jnp.arange(64) < 50
loss, gradient = jax.value_and_grad(dpmjax.info_nce)(queries, keys, jnp.arange(64), mask=mask)
print(f"InfoNCE {float(loss):.3f}, gradient of masked rows: {float(jnp.abs(gradient[50:]).max())}")
