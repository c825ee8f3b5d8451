"""What all commands have in common: signals, closed pipes, full disks, exit codes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from cyclic_env import ConfigError, EnvConfig
from scripts._arguments import EnvArguments, EnvOptions, OptionalInt, parse
from scripts._cli import command, interruptible
from tests.helpers import ROOT, load_script
from tests.scripts.conftest import Refused

SCRIPTS = ["evaluate", "train", "benchmark", "run_knn", "show_plans", "replay", "play", "import_map", "make_ros_maps"]


def run(*arguments: str, **options: object) -> subprocess.Popen[str]:
    """Start a script by its file."""
    script, *rest = arguments
    command = [sys.executable, str(ROOT / "scripts" / f"{script}.py"), *rest]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)  # pyright: ignore[reportArgumentType, reportCallIssue]


@pytest.mark.parametrize("script", SCRIPTS)
def test_ctrl_c_while_the_packages_load_leaves_one_line(script: str) -> None:
    code = (
        "import os, runpy, signal, sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name in ('agents', 'cyclic_env'): os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "sys.path.insert(0, 'scripts')\n"
        "runpy.run_path(sys.argv[1], run_name='__main__')\n"
    )
    arguments = [sys.executable, "-c", code, f"scripts/{script}.py"]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False, cwd=ROOT)
    assert result.returncode == 130
    assert result.stderr.strip() == f"{script}.py: stopped before it began."


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGHUP", 129)])
def test_signals_keep_what_is_done(name: str, code: int, tmp_path: Path) -> None:
    file = tmp_path / "scores.json"
    rest = ["--map", "ring", "--step-budget", "20", "--episodes", "100", "--json", str(file), "--num-envs", "1"]
    with run("evaluate", *["spinning"] * 12, *rest, stdout=subprocess.PIPE) as process:
        while not file.exists():
            assert process.poll() is None
            time.sleep(0.1)
        process.send_signal(getattr(signal, name))
        out, error = process.communicate(timeout=60)
    assert process.returncode == code
    assert f"and in {file}" in error
    assert "spinning" in out
    assert json.loads(file.read_text())["evaluations"]


@pytest.mark.parametrize("full", [False, True])
def test_work_goes_on_when_nobody_reads_what_is_printed(full: bool, tmp_path: Path) -> None:
    """As in ``show_plans.py ... | head -1``, and on a full disk."""
    file = tmp_path / "plans.json"
    with Path("/dev/full").open("w") as full_disk:
        stdout = full_disk if full else subprocess.PIPE
        with run("show_plans", "ring", "--json", str(file), stdout=stdout) as process:
            if process.stdout:
                process.stdout.close()
            assert process.stderr is not None
            error = process.stderr.read()
    assert process.returncode == 0
    assert ("No space left on device" in error) == full
    assert "Traceback" not in error
    assert file.stat().st_size


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a folder that takes no file of more than 50 kB, in this process."""
    resource = pytest.importorskip("resource")
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    yield tmp_path
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_names_the_file(small_disk: Path, refused: Refused) -> None:
    arguments = ["--map", "ring", "--steps", "10", "--num-envs", "1", "--out", small_disk]
    assert str(small_disk / "model.zip") in refused(load_script("train").main, arguments)
    assert not list(small_disk.rglob("*.zip"))


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a command."""

    count: OptionalInt = None
    env: EnvOptions = field(default_factory=EnvArguments)


def test_settings_of_the_environment_are_options() -> None:
    given = "--count 3 --laser.num-beams 360 --robot.radius 0.3 --reward.time -20 --random-start"
    args = parse(Options, given.split(), "some.py", "")
    assert args.count == 3
    config = EnvConfig(**args.env.settings())
    assert (config.random_start, config.laser.num_beams) == (True, 360)
    assert (config.robot.radius, config.reward.time) == (0.3, -20.0)
    assert set(args.env.changed()) == {"random_start", "laser", "robot", "reward"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("--count x", "--count is 'x'; expected INT"),
        ("--cuont 3", "Did you mean --count?"),
        ("--count", "'--count'"),
        ("--robot.radius -1", "RobotConfig.radius is -1.0"),
        ("--laser.num-beams 1.5", "--laser.num-beams"),
    ],
)
def test_what_is_no_option_gets_one_line(given: str, message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse(Options, given.split(), "some.py", "")
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_exit_codes_and_lines(capsys: pytest.CaptureFixture[str]) -> None:
    def main_that_raises(error: BaseException | None) -> int:
        @command(Options)
        def main(args: Options) -> None:
            if error is not None:
                raise error

        return main([])

    assert main_that_raises(None) == 0
    for error in (ConfigError("wrong."), OSError(28, "No space", "file"), MemoryError()):
        assert main_that_raises(error) == 2
        assert capsys.readouterr().err.startswith("test_cli.py: ")
    assert main_that_raises(KeyboardInterrupt()) == 130
    assert main_that_raises(KeyboardInterrupt(signal.SIGTERM)) == 143
    with pytest.raises(ZeroDivisionError):  # a fault of ours keeps its traceback
        main_that_raises(ZeroDivisionError())


def test_a_block_that_is_interrupted_is_left_and_says_so() -> None:
    with interruptible() as interruption:
        pass
    assert not interruption
    with interruptible() as interruption:
        raise KeyboardInterrupt(signal.SIGHUP)
    assert interruption.stopped("all is kept").signum == signal.SIGHUP
