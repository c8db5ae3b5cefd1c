"""Two processes that train as one: the numbers of one process, one writer, and one Ctrl-C for both."""

import socket
from pathlib import Path

import jax
import numpy as np
import pytest
from optax.tree_utils import tree_get

from dpmjax.checkpoints import Checkpoints
from dpmjax.cli.run import CHECKPOINTS, HISTORY
from dpmjax.deeppointmap import SampleMaker, begin_training, init_training, join_processes, make_step
from tests.cli.test_train import TRAINING
from tests.data_sets import run_in
from tests.deeppointmap import toy
from tests.processes import start_python

# The first process gets a signal before its third step of four.
PROCESS = """
import signal, sys
from dpmjax.deeppointmap.training.processes import is_first, join_processes
coordinator, number, folder = sys.argv[1], int(sys.argv[2]), sys.argv[3]
join_processes(coordinator, 2, number)

from pathlib import Path
from dpmjax.cli.train_run import Records, Selection, run_training
from dpmjax.deeppointmap import TrainingHooks, draw_evaluation_pairs
from tests.cli.test_train_processes import TRAINING
from tests.data_sets import run_in
from tests.deeppointmap import toy

calls = []

def stop():
    calls.append(0)
    return signal.SIGINT if number == 0 and len(calls) == 3 else 0

assert is_first() == (number == 0)
sets = Selection(draw_evaluation_pairs([toy.drive(seed=9)], 1, toy.MODEL), "a toy")
records = Records(run_in(Path(folder)), TRAINING, sets, seed=0) if is_first() else None
done = run_training(records, toy.store(), TRAINING, TrainingHooks(evaluate_every=1, stop=stop), seed=0)
assert done.stopped_by == signal.SIGINT
"""


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("localhost", 0))
        return int(sock.getsockname()[1])


@pytest.mark.slow
def test_two_processes_train_as_one_and_stop_as_one(tmp_path: Path) -> None:
    coordinator = f"localhost:{free_port()}"
    both = [start_python("-c", PROCESS, coordinator, number, tmp_path) for number in range(2)]
    try:
        told = [process.communicate(timeout=300) for process in both]
    finally:
        for process in both:
            process.kill()
    assert [process.returncode for process in both] == [0, 0], told
    # The second one shows nothing but what JAX itself says.
    assert all(line.startswith("[Gloo]") for line in told[1][0].splitlines()), told[1][0]
    assert "train:" in told[0][1]
    assert "train:" not in told[1][1]
    assert [row["step"] for row in run_in(tmp_path).read_table(HISTORY)] == ["1", "2"]

    state, step = init_training(jax.random.key(0), TRAINING), make_step(TRAINING)
    maker = SampleMaker(toy.store(), TRAINING, seed=0, numbers=(0, 1), num_in_step=2)
    progress = Checkpoints(tmp_path / CHECKPOINTS).restore_latest(begin_training(TRAINING), fallback=None)
    for number in range(2):
        state, _ = step(state, maker(number))
    assert progress.state.step == progress.best_step == 2
    # Of the squared gradients: Adam makes a whole step of the rounding of a gradient that is zero.
    found, expected = (tree_get(s.optimizer, "nu") for s in (progress.state, state))
    largest = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(expected))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4 * largest), found, expected)


def test_numbers_without_a_coordinator_are_refused() -> None:
    with pytest.raises(ValueError, match="^coordinator: expected HOST:PORT"):
        join_processes(None, 2, 0)
