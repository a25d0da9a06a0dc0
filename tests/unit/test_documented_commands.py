"""Every command that the documents show is one that the programs understand.

Their Python is run by `tests/system/test_documents.py` and the tests in `FENCED`.
"""

import math
import re
import shlex
import subprocess
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
import tyro
import yaml

from egosim_jax.cli.commands import Commands
from egosim_jax.convert.__main__ import Commands as Conversions
from egosim_jax.runtime.command import ExitCode, parse
from egosim_jax.train.__main__ import Commands as Recipes
from egosim_jax.train.online.plan import OnlineTraining

ROOT = Path(__file__).parents[2]
PROGRAMS = {"egosim": Commands, "egosim-train": Recipes, "egosim-convert": Conversions}
PATHS = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "egosim_jax" / "weights" / "tabletop" / "README.md",
    ROOT / "train" / "recipes.py",
]


COMMAND = re.compile(
    r"^    (?:srun .*? )?(?:[A-Z_]+=\S+ )*"
    r"(egosim(?:-train|-convert)? .*?)(?: &)?$",
    re.M,
)
"""In an indented line, behind what starts it and before what sends it to the background."""
MODULE = re.compile(r"^    (?:.*&& )?python -m ([\w.]+)", re.M)
SCRIPT = re.compile(r"^    python (examples/\S+)", re.M)
FENCE = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
FENCED = {
    "environments.md": "tests/unit/interactive/env/test_documented_script.py",
    "policy_training.md": "tests/unit/interactive/learn/test_documented_training.py",
    "protocol.md": "tests/unit/interactive/server/test_documented_protocol.py",
    "serving.md": None,  # openpi-client needs numpy 1
    "streaming.md": None,  # names stand for your own model and policy
}
"""Test that runs the fenced Python of each page; None if it is only compiled."""
DRY_RUN = re.compile(r"^#   (egosim train .* --preflight .*)$", re.M)
SLURM = ROOT / "examples" / "slurm" / "egosim_14b.sbatch"
PODS = {path.stem: path for path in sorted((ROOT / "examples" / "gke").glob("*.yaml"))}


def shown(path: Path) -> list[str]:
    """The commands in a document."""
    return COMMAND.findall(path.read_text("utf-8").replace("\\\n", " "))


def slurm_array() -> list[str]:
    """The command of the script for Slurm, without its comments."""
    (lines,) = re.findall(r"^train=\(\n(.*?)^\)", SLURM.read_text(), re.M | re.S)
    return shlex.split(lines, comments=True)


def job(name: str) -> dict:
    """The only job of a manifest for Kubernetes."""
    manifest = yaml.safe_load(PODS[name].read_text())
    (replicated,) = manifest["spec"]["replicatedJobs"]
    return replicated["template"]["spec"]


def container(name: str) -> dict:
    (found,) = job(name)["template"]["spec"]["containers"]
    return found


def dry_run(name: str) -> str:
    (command,) = DRY_RUN.findall(PODS[name].read_text())
    return command


EXAMPLES = {
    shlex.join(slurm_array()),
    *(shlex.join(container(name)["command"]) for name in PODS),
    *map(dry_run, PODS),
}
COMMANDS = sorted({command for path in PATHS for command in shown(path)} | EXAMPLES)


def pages(nav: list | str) -> list[str]:
    """The pages of the navigation."""
    if isinstance(nav, str):
        return [nav]
    return [page for entry in nav for part in entry.values() for page in pages(part)]


def test_the_navigation_has_every_page_once():
    nav = tomllib.loads((ROOT / "zensical.toml").read_text("utf-8"))["project"]["nav"]
    assert sorted(pages(nav)) == sorted(path.name for path in (ROOT / "docs").glob("*.md"))
    assert [name for entry in nav[1:] for name in entry] == [
        "Tutorial",
        "How-to guides",
        "Reference",
        "Explanation",
    ]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_modules_and_scripts_of_a_page_exist(path):
    text = path.read_text("utf-8")
    assert all((ROOT / script).exists() for script in SCRIPT.findall(text))
    for module in MODULE.findall(text):
        assert module == "venv" or find_spec(module)


def test_fenced_python_has_a_test():
    found = {path.name for path in PATHS if FENCE.search(path.read_text("utf-8"))}
    assert found == FENCED.keys()
    for name, test in FENCED.items():
        for code in FENCE.findall((ROOT / "docs" / name).read_text("utf-8")):
            compile(code, name, "exec")
        assert test is None or name in (ROOT / test).read_text("utf-8")


def test_there_are_commands_of_every_program():
    assert {command.split()[0] for command in COMMANDS} == PROGRAMS.keys()
    assert len(COMMANDS) > 40


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_understood(command):
    program, *args = shlex.split(command)
    if program == "egosim" and args[0] in ("train", "convert"):
        program = f"egosim-{args.pop(0)}"
    if args[:2] == ["tabletop", "--online"]:
        tyro.cli(OnlineTraining, args=args[2:])
        return
    parse(PROGRAMS[program], args, program=program)


def training(command: str) -> list[tuple[str, str]]:
    """The options of the training, which decide the rows and the memory."""
    return re.findall(r"--training\.(\S+?)[= ](\S+)", command)


def test_a_dry_run_has_the_options_of_its_example():
    assert PODS.keys() == {"gpu", "tpu"}
    for name in PODS:
        command = shlex.join(container(name)["command"])
        assert training(command) == training(dry_run(name)) != []


def test_the_pods_are_the_hosts_of_the_target():
    """Each pod has all GPUs of a node, or the four chips of a host of TPU v5p."""
    for name, resource in (("gpu", "nvidia.com/gpu"), ("tpu", "google.com/tpu")):
        size = dry_run(name).partition("--preflight ")[2].split()[0].partition(":")[2]
        count, each = job(name)["completions"], container(name)["resources"]["limits"][resource]
        assert math.prod(map(int, size.split("x"))) == count * each
        assert job(name)["parallelism"] == count
    nodes = job("tpu")["template"]["spec"]["nodeSelector"]
    assert f":{nodes['cloud.google.com/gke-tpu-topology']} " in dry_run("tpu")
    shared = {variable["name"]: variable.get("value") for variable in container("gpu")["env"]}
    assert shared["JAX_NUM_PROCESSES"] == str(job("gpu")["completions"])
    jobset = yaml.safe_load(PODS["gpu"].read_text())
    first = f"{jobset['metadata']['name']}-{jobset['spec']['replicatedJobs'][0]['name']}-0-0"
    assert shared["JAX_COORDINATOR_ADDRESS"].startswith(f"{first}.{jobset['metadata']['name']}:")


def test_pods_start_again_unless_they_would_fail_again():
    for name, path in PODS.items():
        failures = yaml.safe_load(path.read_text())["spec"]["failurePolicy"]
        assert failures["rules"] == [
            {"action": "FailJobSet", "onJobFailureReasons": ["PodFailurePolicy"]}
        ]
        (rule,) = job(name)["podFailurePolicy"]["rules"]
        assert rule["action"] == "FailJob"
        assert rule["onExitCodes"]["values"] == [
            ExitCode.FAILED,
            ExitCode.USAGE,
            ExitCode.INTERRUPTED,
        ]
        assert rule["onExitCodes"]["containerName"] == container(name)["name"]
        assert job(name)["template"]["spec"]["restartPolicy"] == "Never"
        assert job(name)["backoffLimit"] == 0


@pytest.mark.parametrize(
    ("code", "restarts", "requeued"),
    [
        (0, 0, False),
        (2, 0, False),
        (70, 0, True),
        (75, 0, True),
        (137, 0, True),
        (130, 0, False),
        (75, 50, False),
    ],
)
def test_slurm_starts_it_again_unless_it_would_fail_again(tmp_path, code, restarts, requeued):
    for program, text in {
        "srun": f'echo srun "$@"; exit {code}',
        "scontrol": 'echo scontrol "$@"',
        "egosim": 'echo "$@"',
    }.items():
        path = tmp_path / program
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o700)
    env = {"PATH": f"{tmp_path}:/usr/bin:/bin"}
    job = {"SLURM_JOB_ID": "7", "SLURM_RESTART_COUNT": str(restarts)}
    done = subprocess.run(["bash", SLURM], env=env | job, capture_output=True, text=True)
    assert done.returncode == code
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[0] == shlex.join(["srun", *slurm_array()])
    assert lines[1:] == ["scontrol requeue 7"] * requeued
    dry = subprocess.run(["bash", SLURM], env=env, capture_output=True, text=True)
    assert dry.stdout == shlex.join(slurm_array()[1:]) + " --preflight h200:32 --no-search\n"
