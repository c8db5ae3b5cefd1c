"""Your own training loop: pairs, loss and optimiser are yours, the encoder is a pure function of its parameters."""

import jax
import jax.numpy as jnp
import optax

import dpmjax
from dpmjax import deeppointmap, simulation
from dpmjax.geometry import rigid

drive = simulation.simulate_drive(3, kind="suburb", length_m=30)
model = dpmjax.init_model(jax.random.key(0), dpmjax.model_preset("tiny"))
# Neighbourhoods need no network, so each scan is prepared once, on the host.
pyramids = [deeppointmap.pyramid_of_scan(drive[i], model.config) for i in range(8)]
pyramids = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pyramids)
T_world_scan = jnp.asarray(drive.T_world_lidar[:8])
optimizer = optax.adam(1e-3)
state = optimizer.init(model.params)


def loss(model, rows):
    """Returns InfoNCE of two scans; the positive is the nearest descriptor of the second scan within 2 m."""
    a, b = (dpmjax.encode_pyramid(model, jax.tree.map(lambda leaf, row=row: leaf[row], pyramids)) for row in rows)
    T_b_a = jnp.linalg.inv(T_world_scan[rows[1]]) @ T_world_scan[rows[0]]
    near = dpmjax.radius_search(rigid.transform_points(T_b_a, a.positions), b.positions, 2.0, 1, mask=b.mask)
    positives = jnp.where(near.mask[:, 0], near.indices[:, 0], -1)
    return dpmjax.info_nce(a.features, b.features, positives, mask=a.mask)


@jax.jit
def step(model, state, rows):
    value, gradient = jax.value_and_grad(loss)(model, rows)
    updates, state = optimizer.update(gradient.params, state)
    return model.replace(params=optax.apply_updates(model.params, updates)), state, value


for number in range(20):
    model, state, value = step(model, state, jax.random.choice(jax.random.key(number), 8, (2,), replace=False))
    if number % 5 == 0:
        print(f"step {number}: loss {value:.3f}")
