"""Processes that the launcher starts: their variables, output, ends and restarts."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from egosim_jax.train import launch
from egosim_jax.train.launch import Launch, gpu_shares
from egosim_jax.types import InputError

SAY = (
    "import os, sys, time, signal\n"
    "index = int(os.environ['JAX_PROCESS_ID'])\n"
    "def say(*words): print(*words, flush=True)\n"
)


def start(code: str, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "egosim_jax.train.launch", *options, "--"]
    return subprocess.Popen(
        [*command, sys.executable, "-S", "-c", SAY + code],
        env=os.environ | {"CUDA_VISIBLE_DEVICES": "4,5,6,7"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_each_process_gets_its_variables_and_gpus_and_prefixes_its_lines():
    code = (
        "say(*(os.environ[f'JAX_{name}'] for name in ('COORDINATOR_ADDRESS', 'NUM_PROCESSES')),"
        "os.environ['CUDA_VISIBLE_DEVICES'])"
    )
    machine = ("--nodes", "2", "--node-rank", "1", "--coordinator", "10.0.0.1:1234")
    process = start(code, "--processes", "2", *machine)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    assert sorted(out.splitlines()) == ["[2] 10.0.0.1:1234 4 4,5", "[3] 10.0.0.1:1234 4 6,7"]


def test_one_process_fails_and_the_other_is_ended_without_a_restart():
    process = start(
        "if index == 1: time.sleep(0.3); sys.exit(2)\n"
        "signal.signal(signal.SIGTERM, lambda *_: (say('saved'), os._exit(75)))\n"
        "time.sleep(60)",
        "--processes",
        "2",
    )
    out, errors = process.communicate(timeout=300)
    assert process.returncode == 2
    assert out == "[0] saved\n"
    assert errors == ""


def test_a_run_whose_process_is_killed_starts_again(tmp_path: Path):
    code = (
        f"first = not os.path.exists('{tmp_path}/started')\n"
        f"if index == 0: open('{tmp_path}/started', 'w').close()\n"
        "if index == 0 and first: os.kill(os.getpid(), 9)\n"
        "if first: time.sleep(60)\n"
    )
    process = start(code, "--processes", "2")
    said = "a process ended with 137; restarts left: 10\n"
    assert process.communicate(timeout=300) == ("", said)
    assert process.returncode == 0


def test_a_run_whose_process_is_interrupted_does_not_start_again():
    process = start("say('started'); sys.exit(130)")
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 130
    assert out == "[0] started\n"


def test_restarts_are_limited():
    process = start("say('started'); sys.exit(75)", "--restarts", "1")
    out, errors = process.communicate(timeout=300)
    assert process.returncode == 75
    assert out == "[0] started\n" * 2
    assert errors == "a process ended with 75; restarts left: 1\n"


def test_sigterm_reaches_the_processes_which_are_not_started_again():
    code = (
        "signal.signal(signal.SIGTERM, lambda *_: os._exit(75))\n"
        "os.fork() or time.sleep(60)\n"  # its child outlives it
        "say('ready'); time.sleep(60)"
    )
    process = start(code)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=300)
    assert process.returncode == 75


def test_a_process_that_ignores_its_end_is_killed_with_its_children(monkeypatch):
    monkeypatch.setattr(launch, "END_S", 0.5)
    code = "import signal, time; signal.signal(15, signal.SIG_IGN); print(1, flush=True)"
    deaf, failing = (
        subprocess.Popen(
            [sys.executable, "-S", "-c", program], stdout=subprocess.PIPE, start_new_session=True
        )
        for program in (f"{code}; time.sleep(60)", "import time; time.sleep(0.1); raise SystemExit")
    )
    with deaf, failing:
        assert deaf.stdout is not None
        deaf.stdout.readline()
        failing.kill()
        begun = time.monotonic()
        assert launch._wait([deaf, failing]) == 137
        assert time.monotonic() - begun < 10
        assert deaf.returncode == -9


def test_a_preflight_runs_once_and_starts_nothing(capfd):
    program = (sys.executable, "-S", "-c", "print('report')", "--preflight", "h200:16")
    assert Launch(program=program, processes=2).run() == 0
    assert capfd.readouterr().out == "report\n"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "No command"),
        ({"program": ("true",), "processes": 0}, "0 processes"),
        ({"program": ("true",), "nodes": 2, "node_rank": 2}, "machine 2 of 2"),
        ({"program": ("true",), "nodes": 2}, "--coordinator"),
    ],
)
def test_wrong_options_are_refused(options, says):
    with pytest.raises(InputError, match=says):
        Launch(**options).run()


def test_gpus_are_shared_evenly_and_in_order(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-a,GPU-b,GPU-c,GPU-d")
    assert [share["CUDA_VISIBLE_DEVICES"] for share in gpu_shares(2)] == [
        "GPU-a,GPU-b",
        "GPU-c,GPU-d",
    ]
    with pytest.raises(InputError, match="4 GPUs cannot be shared by 3 processes"):
        gpu_shares(3)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert gpu_shares(2) == [{}, {}]
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setattr(os, "listdir", lambda _: ["nvidia0", "nvidia1", "nvidiactl", "null"])
    assert gpu_shares(1) == [{"CUDA_VISIBLE_DEVICES": "0,1"}]
