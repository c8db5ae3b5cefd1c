"""The program `dpmjax`: subcommands, help, exit codes."""

import pytest

import dpmjax
from dpmjax.cli import program
from tests.processes import run_python

HELP = {
    "map2d": ("-o OUT", "-n N", "-j N", "--preset {fast,paper}", "--init", "--no-refine", "--seed", "--resume"),
    "train": ("--preset {tiny,small,paper}", "--data", "-o OUT", "--resume"),
}
"""Options that the help of a subcommand must name."""


def test_help_lists_every_subcommand_and_loads_nothing() -> None:
    code = (
        "import sys; from dpmjax.cli.program import main; code = main(['--help']);"
        "assert not {'jax', 'numpy', 'tyro'} & sys.modules.keys(); raise SystemExit(code)"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    assert all(f"\n  {name} " in done.stdout for name in program.COMMANDS)
    assert "examples:" in done.stdout


def test_helps_of_subcommands_have_examples_and_load_nothing_slow() -> None:
    code = (
        "import sys; from dpmjax.cli.program import COMMANDS, main\n"
        "for name in COMMANDS: print('HELP', name); assert main([name, '--help']) == 0\n"
        "assert not {'jax', 'scipy', 'matplotlib'} & sys.modules.keys()"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    helps = dict(text.split("\n", 1) for text in done.stdout.split("HELP ")[1:])
    assert helps.keys() == program.COMMANDS.keys()
    for name, text in helps.items():
        for part in (f"    dpmjax {name}", *HELP.get(name, ())):
            assert part in text


@pytest.mark.slow
@pytest.mark.parametrize(("module", "name"), [("deepmapping_2d", "map2d"), ("dpm_train", "train")])
def test_an_experiment_of_another_name_is_the_subcommand(module: str, name: str) -> None:
    done, same = run_python("-m", f"experiments.{module}", "--help"), run_python("-m", "dpmjax", name, "--help")
    assert (done.returncode, done.stdout) == (0, same.stdout), done.stderr


def test_a_stop_during_the_imports_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("importlib.import_module", interrupted)
    assert program.main(["slam"]) == 130
    assert capsys.readouterr().err == "dpmjax: stopped by SIGINT\n"


def test_a_stop_during_a_compilation_ends_the_process_at_once() -> None:
    code = """
import signal, jax, jax.numpy as jnp
from dpmjax.cli import program

def unrolled(x):
    for _ in range(300):
        x = jnp.sort(jnp.sin(x) @ x, axis=0)
    return x

lowered = jax.jit(unrolled).lower(jnp.ones((8, 8)))
signal.signal(signal.SIGALRM, signal.default_int_handler)
signal.setitimer(signal.ITIMER_REAL, 0.3)
try:
    lowered.compile()
except KeyboardInterrupt:
    program.end_process(program.EXIT_INTERRUPTED)
"""
    done = run_python("-c", code)
    assert (done.returncode, done.stderr) == (program.EXIT_INTERRUPTED, "")


@pytest.mark.parametrize("arguments", [[], ["mapp2d"], ["--nope"]])
def test_wrong_usage_is_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main(arguments) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "register, map2d" in errors


def test_version() -> None:
    done = run_python("-m", "dpmjax", "--version")
    assert (done.returncode, done.stdout) == (0, f"dpmjax {dpmjax.__version__}\n")


def test_info_names_versions_device_and_weights(capsys) -> None:
    assert program.main(["info"]) == 0
    output = capsys.readouterr().out
    for part in (f"dpmjax {dpmjax.__version__}", "cpu", "dpm_small"):
        assert part in output
