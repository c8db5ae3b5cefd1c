"""Trains a network on simulated scans with known poses: 20 steps here, hours for good weights."""

import dpmjax
from dpmjax import deeppointmap, simulation

settings = deeppointmap.training_preset("tiny").with_steps(20)

# Pyramids of points are built once for each scan; steps draw groups of scans and move them at random.
drive = simulation.simulate_drive(num_scans=40)
store = deeppointmap.ScanStore([deeppointmap.prepare_drive(drive, settings)])


def show(record, progress):
    """Prints the loss of every fifth step."""
    if record.step % 5 == 0:
        print(f"step {record.step}: loss {float(record.report.loss):.3f}")


trained = deeppointmap.train(store, settings, seed=0, hooks=deeppointmap.TrainingHooks(on_report=show))
dpmjax.save_model(trained.model, "tiny.safetensors", card="20 steps on one simulated drive")
model = dpmjax.load_model("tiny.safetensors")
print(f"{trained.speed.scans_per_s:.0f} scans a second, confidence {dpmjax.register(model, drive[0], drive[3]).confidence}")
