"""Behavior of every command line: version, suggestions, errors in one line."""

import ast
import dataclasses
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import egosim_jax
from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.cli.annotate import Annotate
from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.cli.generate import Generate
from egosim_jax.cli.simulate import Simulate
from egosim_jax.convert.__main__ import main as convert
from egosim_jax.io.atomic import lock_folder
from egosim_jax.runtime import command, failures, interrupts
from egosim_jax.train.__main__ import main as train
from egosim_jax.train.config import TrainConfig
from egosim_jax.train.recipes import RECIPES
from egosim_jax.types import InputError, MeshConfig

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("program", "name"), [(egosim, "egosim"), (train, "egosim-train"), (convert, "egosim-convert")]
)
def test_every_program_says_its_version(program, name, capsys):
    assert program(["--version"]) == command.ExitCode.DONE
    assert capsys.readouterr().out == f"{name} {egosim_jax.__version__}\n"


def test_python_dash_m_egosim_jax_is_egosim(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["egosim_jax", "--version"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("egosim_jax", run_name="__main__")
    assert ended.value.code == command.ExitCode.DONE
    assert capsys.readouterr().out.startswith("egosim ")


@pytest.mark.parametrize(
    ("program", "args", "meant"),
    [
        (egosim, ["simulte", "--out", "x"], "Did you mean simulate?"),
        (egosim, ["data", "pak"], "Did you mean pack?"),
        (egosim, ["experiment", "tabeltop"], "Did you mean tabletop?"),
        (train, ["debugg", "--out", "x"], "Did you mean debug?"),
        (convert, ["to_torch"], "Did you mean to-torch?"),
        (egosim, ["trian"], "Did you mean train?"),
        (egosim, ["convert", "to_torch"], "egosim convert has no command 'to_torch'. Did you"),
        (egosim, ["zzz"], "All: generate, "),
    ],
)
def test_a_mistyped_command_gets_a_suggestion_in_one_line(program, args, meant, capsys):
    assert program(args) == command.ExitCode.USAGE
    said = capsys.readouterr().err
    assert meant in said
    assert said.count("\n") == 1


def test_egosim_alone_names_commands_that_there_are(capsys):
    assert egosim([]) == command.ExitCode.DONE
    for line in re.findall(r"^  egosim (.*?)  ", capsys.readouterr().out, re.M):
        words = [word for word in line.split() if not word.startswith("-")]
        with pytest.raises(SystemExit) as ended:
            egosim([*words[: 1 + (words[0] in ("data", "episode", "models"))], "--help"])
        assert ended.value.code == 0


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_seeds_out_of_range_are_refused(seed, tmp_path, capsys):
    with pytest.raises(InputError, match="--seed must be a whole number"):
        TrainConfig(steps=1, seed=seed)
    args = ["simulate", "--seed", str(seed), "--out", str(tmp_path)]
    assert egosim(args) == command.ExitCode.USAGE
    assert "--seed must be a whole number" in capsys.readouterr().err


@pytest.mark.parametrize("extra", ["tensorboard", "wandb"])
def test_a_missing_extra_is_found_before_anything_starts(extra, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("egosim_jax.train.metric_writers.find_spec", lambda name: None)
    for package in ("tensorboardX", "wandb"):  # another test may have imported it
        monkeypatch.delitem(sys.modules, package, raising=False)
    option = [f"--denoiser.{extra}", *(["clips"] if extra == "wandb" else [])]
    assert train(["debug", "--out", str(tmp_path / "run"), *option]) == command.ExitCode.USAGE
    assert f"pip install 'egosim-jax[{extra}]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("code", failures.REFUSALS)
def test_an_error_of_the_system_is_one_line_with_a_fix(code, capsys):
    """Also if a library has the system's reason only in the text of an error."""
    reason = os.strerror(code)
    errors = [OSError(code, reason, "/a"), RuntimeError(f"/a: write failed\n{reason} [/b]")]

    def run():
        raise errors.pop()

    while errors:
        assert command.run_with_exit_codes(run) == command.ExitCode.FAILED
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert said.startswith("error: /a: ")
        assert failures.REFUSALS[code] in said


def test_an_interrupt_that_python_ignores_comes_again():
    """An exception in a callback of the garbage collector is ignored, and the signal with it."""
    code = """
import gc, os, signal, time
from egosim_jax.runtime import interrupts
interrupts.expect()
sent = []
def collect(phase, info):
    if not sent:
        sent.append(phase)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
gc.callbacks.append(collect)
try:
    gc.collect()
    time.sleep(30)
    print("lost")
except KeyboardInterrupt:
    print("interrupted", sent)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "interrupted ['start']\n"
    assert "ignored" not in ended.stderr


MAKE = ["egosim", "data", "make", "--out", "a folder"]


@pytest.mark.parametrize(
    ("argv", "made", "line"),
    [
        (MAKE, None, None),
        (MAKE, "config.json", None),
        (MAKE, "clip_1/.frames.tmp.npz", None),
        (MAKE, "clip_1/frames.npz", "egosim data make --out 'a folder' --skip-existing"),
        (["egosim train", "debug"], "result", "egosim train debug --skip-existing"),
        (["/my bin/egosim", "simulate"], "result", "'/my bin/egosim' simulate --skip-existing"),
    ],
)
def test_ctrl_c_says_how_to_continue_only_if_there_are_results(
    monkeypatch, capsys, tmp_path, argv, made, line
):
    def run():
        for _ in range(2):
            interrupts.resume_by("--skip-existing")
        with lock_folder(tmp_path):
            if made is not None:
                (tmp_path / made).parent.mkdir(exist_ok=True)
                (tmp_path / made).touch()
            raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", argv)
    assert command.run_with_exit_codes(run) == command.ExitCode.INTERRUPTED == 130
    how = "" if line is None else f"; to continue: {line}"
    assert capsys.readouterr().err == f"interrupted{how}\n"


@pytest.mark.parametrize(
    ("program", "args"),
    [
        (egosim, ["simulate"]),
        (egosim, ["generate", "--config", "tabletop"]),
        (egosim, ["data", "make", "tabletop"]),
        (egosim, ["episode", "make"]),
        (egosim, ["experiment", "tabletop"]),
        (train, ["debug"]),
        (convert, ["to-torch", "weights"]),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, list) else "",
)
def test_a_file_as_out_is_refused_before_any_work(program, args, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("README.md").write_text("mine", "utf-8")
    for out in ("README.md", "README.md/below"):
        if args[0] == "to-torch":
            args = [*args[:2], "--config", "debug"]
        assert program([*args, "--out", out]) == command.ExitCode.USAGE
        said = capsys.readouterr().err
        assert "error: README.md is a file" in said
        assert "(--out)" in said
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


@pytest.mark.parametrize("words", [["data", "pack", "--metadata"], ["view"], ["episode", "make"]])
def test_a_path_that_is_not_utf8_is_refused_with_a_way_to_rename_it(words, capsys):
    path = os.fsdecode(b"caf\xe9/metadata.csv")
    assert egosim([*words, path]) == 2
    error = capsys.readouterr().err
    assert "caf\\udce9/metadata.csv" in error
    assert "convmv" in error
    assert "Traceback" not in error


@pytest.mark.parametrize("through", ["the current folder", "a link", "a folder above"])
def test_a_path_that_leads_to_a_name_that_is_not_utf8_is_refused(
    through, tmp_path, monkeypatch, capsys
):
    (place := tmp_path / os.fsdecode(b"caf\xe9")).mkdir()
    (tmp_path / "link").symlink_to(place)
    monkeypatch.chdir(place if through != "a link" else tmp_path)
    if through == "a folder above":
        (place / "below").mkdir()
        monkeypatch.chdir("below")
    out = "link" if through == "a link" else "out"
    assert egosim(["data", "make", "tabletop", "--scenes", "1", "--out", out]) == 2
    error = capsys.readouterr().err
    assert "caf\\udce9" in error
    assert "convmv" in error
    assert not any(place.rglob("out"))


def test_a_library_that_cannot_take_a_name_is_no_bug(capsys):
    def run():
        try:
            f"{'a' * 1000}/caf\udce9/{'b' * 1000}".encode()
        except UnicodeEncodeError as error:
            raise RuntimeError("of a library") from error

    assert command.run_with_exit_codes(run) == 2
    error = capsys.readouterr().err
    assert "caf\\udce9" in error
    assert len(error) < 400


HOSTILE = "a\x1b[31mb\x07\u202ec"
"""Name that would color a terminal, ring its bell and write backwards."""


def test_no_name_reaches_the_terminal_raw(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = ["data", "make", "tabletop", "--scenes", "1", "--frames", "5", "--workers", "1"]
    made += ["--height", "32", "--width", "48", "--out", f"{HOSTILE}.shards"]
    assert egosim(made) == 0
    assert egosim(["data", "look", "--shards", f"{HOSTILE}.shards", "--out", f"{HOSTILE}.png"]) == 0
    assert egosim(["data", "check", "--shards", f"{HOSTILE}.shards"]) == 0
    assert egosim(["data", "stats", "--shards", f"{HOSTILE}.shards"]) == 0
    assert egosim(["view", f"{HOSTILE}.ply"]) == 2
    said = capsys.readouterr()
    assert said.out.startswith("a\\x1b[31mb\\x07\\u202ec.shards\n")
    assert not {*"\x1b\x07\u202e"} & {*said.out, *said.err}


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_stdout_of_any_encoding_gets_all_text(tmp_path, encoding):
    code = "import sys; from egosim_jax.runtime.command import run_with_exit_codes as run; "
    code += "from egosim_jax.runtime.terminal import print_line; "
    code += "sys.exit(run(lambda: print(sys.argv[1]) or print_line(sys.argv[1]) or 0))"
    ran = subprocess.run(
        [sys.executable, "-c", code, "日本 Ω"], capture_output=True,
        env=os.environ | {"PYTHONIOENCODING": f"{encoding}:strict"},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    shown = "日本 Ω".encode(encoding, "backslashreplace") + b"\n"
    assert ran.stdout == 2 * shown


def test_paths_are_printed_by_the_function_that_escapes_them():
    """`print` gets no variable by itself on stdout: it may be a path."""
    raw = []
    for top in ("egosim_jax", "train", "convert"):
        for path in (ROOT / top).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                name = getattr(getattr(node, "func", None), "id", None)
                if name == "print" and "file" not in [word.arg for word in node.keywords]:
                    kinds = (ast.Name, ast.Attribute, ast.BinOp)
                    raw += [ast.unparse(node) for a in node.args if isinstance(a, kinds)]
    assert raw == ["print(START)"]


def test_a_command_that_writes_a_file_replaces_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("sheet.png").touch()
    assert egosim(["episode", "show", "none", "--out", "sheet.png"]) == command.ExitCode.USAGE
    assert "sheet.png" not in capsys.readouterr().err
    for words, said in (
        ("make --out sheet.png", "a folder or .zip file, new or of the same run"),
        ("show none --out sheet.png/b", "is a file: sheet.png/b cannot be written"),
    ):
        assert egosim(["episode", *words.split()]) == command.ExitCode.USAGE
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("words", ["generate --help", "--version", "convert --version"])
def test_a_reader_that_ends_early_gets_no_traceback(words):
    code = f"from egosim_jax.cli.__main__ import main; raise SystemExit(main({words.split()!r}))"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert b"BrokenPipe" not in done.stderr
    assert b"Traceback" not in done.stderr


TRAININGS = list(dict.fromkeys(type(recipe) for _, recipe in RECIPES.values()))
GROUPED = [Annotate, Evaluate, Generate, Simulate, *TRAININGS]


@pytest.mark.parametrize("kind", GROUPED)
def test_help_begins_with_few_options_and_every_other_is_in_one_group(kind):
    grouped = [name for names in kind.help_groups.values() for name in names]
    fields = {field.name: field for field in dataclasses.fields(kind)}
    first = [
        n for n, field in fields.items() if n not in grouped and "Config" not in str(field.type)
    ]
    assert len(set(grouped)) == len(grouped)
    assert set(grouped) < fields.keys()
    assert len(first) <= 7
    assert not set(first) & kind.help_groups.keys()


@pytest.mark.parametrize(
    ("words", "first"),
    [
        ("simulate", "Act several times in a scene that keeps its changes"),
        ("data annotate", "Make clips with prior, mask, hands"),
        ("train debug", "Train `debug` for a few updates"),
        ("convert weights", "Convert every network of a checkpoint folder"),
    ],
)
def test_the_help_of_a_command_begins_with_its_description(words, first, capsys):
    with pytest.raises(SystemExit):
        egosim([*words.split(), "--help"])
    usage, description, *_ = capsys.readouterr().out.split("\n\n")
    assert usage.startswith("usage: egosim ")
    assert description.startswith(first)


def test_grouped_options_arrive_in_their_fields(monkeypatch):
    found = []
    monkeypatch.setattr(Generate, "run", lambda self: found.append(self) or 0)
    args = "generate --config debug --steps 3 --robot --start 1 2 --mesh.data 4"
    assert egosim(shlex.split(args)) == command.ExitCode.DONE
    mesh = MeshConfig(data=4, fsdp=1)
    assert found == [Generate(config="debug", steps=3, robot=True, start=(1, 2), mesh=mesh)]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("egosim simul", "simulate"),
        ("egosim generate --str", "--strength"),
        ("egosim convert weights --wid", "--widen"),
        ("egosim train debug --clip-f", "--clip-frames"),
    ],
)
def test_the_printed_script_completes_commands_and_options_in_bash(
    words, expected, tmp_path, capsys
):
    with pytest.raises(SystemExit):
        egosim(["--tyro-print-completion", "bash"])
    script = tmp_path / "egosim"
    script.write_text(capsys.readouterr().out)
    last = len(words.split()) - 1
    code = (
        f"source {script}; COMP_WORDS=({words}); COMP_CWORD={last}; "
        '$(complete -p egosim | grep -o "_tyro[a-z_]*"); echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [expected]


@pytest.mark.parametrize(
    ("args", "wanted", "other"),
    [
        (["serve", "--prot", "3"], "--port", "--prompt"),
        (["simulate", "--seeed", "3"], "--seed", "in egosim"),
        (["play", "--perseption", "x"], "--perception", "in egosim"),
        (["data", "annotate", "v.mp4", "--out", "o", "--min-hand", "1"], "--min-hands", "generate"),
        (["data", "import", "lerobot", "x", "--out", "o", "--fpss", "3"], "lerobot", "nerfstudio"),
    ],
    ids=lambda value: " ".join(value[:3]) if isinstance(value, list) else value,
)
def test_an_unknown_option_is_compared_with_those_of_its_command(args, wanted, other, capsys):
    with pytest.raises(SystemExit) as ended:
        egosim(args)
    captured = capsys.readouterr()
    text = captured.out + captured.err
    assert ended.value.code == 2
    assert wanted in text
    assert other not in text
