"""Trains a network on simulated scans with known poses: 10 steps here, hours for good weights."""

from dataclasses import replace

import dpmjax
from dpmjax import deeppointmap, simulation

# One stage of the curriculum, pairs; the preset has several, up to groups of eight.
stages = (deeppointmap.CurriculumStage(max_group=2, num_steps=10),)
settings = replace(deeppointmap.training_preset("tiny"), curriculum=stages, num_variants=1, stages=("registration",))


def show(record, progress):
    """Prints the loss of every second step."""
    if record.step % 2 == 0:
        print(f"step {record.step}: loss {float(record.report.loss):.3f}")


# Each scan is prepared once; then each step draws groups of scans and moves them at random.
drive = simulation.simulate_drive(3, kind="suburb", length_m=50)
trained = dpmjax.train([drive], settings, seed=0, hooks=deeppointmap.TrainingHooks(on_report=show))

# The file is a model like the shipped one.
dpmjax.save_model(trained.model, "tiny.safetensors", card="10 steps on one simulated drive")
match = dpmjax.register(dpmjax.load_model("tiny.safetensors"), drive[0], drive[3])
print(f"{trained.speed.scans_per_s:.0f} scans a second; score of a pair {float(match.confidence):.2f}")
