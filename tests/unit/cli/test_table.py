"""`egosim table`: folders of clips in the papers' tables, output files and cache."""

import csv
import dataclasses
import io
import json

import numpy as np
import pytest
from flax import nnx

from egosim_jax.cli.table import Name, TableCommand
from egosim_jax.evaluation import scoring
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.evaluation.metrics.image import psnr
from egosim_jax.evaluation.tables import TABLES
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError


@pytest.fixture(scope="module")
def network():
    """A small network for LPIPS, which is compiled once."""
    stage = (lpips.Convolution(features=4),)
    alex = dataclasses.replace(lpips.CONFIGS["alex"], stages=(stage,) * 5)
    return lpips.Lpips(alex, rngs=nnx.Rngs(0))


@pytest.fixture(autouse=True)
def installed(network, monkeypatch):
    """Let commands find the network."""
    known = {"alex": network}
    monkeypatch.setattr(lpips, "load_if_installed", known.get)


@pytest.fixture
def metadata(make_clips):
    """Metadata of four clips of two datasets."""
    path = make_clips(4)
    header, *lines = path.read_text().splitlines()
    sets = ("egodex", "egodex", "egovid", "other")
    lines = [f"{line},{name}" for line, name in zip(lines, sets, strict=True)]
    path.write_text("\n".join([f"{header},dataset", *lines]) + "\n")
    return path


@pytest.fixture
def folders(metadata, tmp_path):
    """Folders of two methods; the second has its clips in a subfolder of their dataset."""
    for number, dataset in enumerate(("egodex", "egodex", "egovid")):
        target = target_of(metadata, f"clip{number}")
        write_video(tmp_path / "near" / f"clip{number}.mp4", target // 2 + 60 + 3 * number, 16)
        write_video(tmp_path / "far" / dataset / f"clip{number}.mp4", target // 4, 16)
    return f"{tmp_path / 'near'}", f"Far={tmp_path / 'far'}"


def target_of(metadata, name):
    return read_video(metadata.parent / name / "video.mp4").frames


def make(metadata, folders, out, **options):
    options = {"name": "egosim", "page_clips": 0, **options}
    return TableCommand(generated=folders, metadata=metadata, out=out, **options).run()


def read_rows(out):
    return list(csv.DictReader(io.StringIO((out / "scores.csv").read_text())))


def test_a_table_has_its_groups_methods_and_published_figures(metadata, folders, tmp_path, capsys):
    assert make(metadata, folders, tmp_path / "out") == ExitCode.DONE
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert {group: list(methods) for group, methods in report["splits"].items()} == {
        group: ["near", "Far", "prior", "prior_fit", "still"] for group in ("egodex", "egovid")
    }
    assert report["published"]["rows"]["egodex"]["EgoSim"]["psnr"] == 25.056
    printed = capsys.readouterr().out
    assert "EgoDex, 2 clips" in printed
    assert "EgoSim (published)" in printed
    assert "LANCZOS" in printed
    assert "frame 0 excluded" in printed


def test_there_is_a_row_for_each_clip_and_method(metadata, folders, tmp_path):
    make(metadata, folders, tmp_path / "out", baselines=("still",))
    rows = {(row["video_id"], row["method"]): row for row in read_rows(tmp_path / "out")}
    assert len(rows) == 3 * 3
    row, target = rows["clip2", "Far"], target_of(metadata, "clip2")
    video = read_video(tmp_path / "far" / "egovid" / "clip2.mp4").frames
    assert float(row["psnr"]) == pytest.approx(psnr(video, target)[1:].mean())
    assert (row["dataset"], row["first_frame"], row["frames_scored"]) == ("egovid", "1", "8")


def test_methods_are_compared_on_the_frames_that_all_have(metadata, folders, tmp_path):
    short = target_of(metadata, "clip0")[:6] // 4
    write_video(tmp_path / "far" / "egodex" / "clip0.mp4", short, 16)
    make(metadata, folders, tmp_path / "out", baselines=())
    rows = [row for row in read_rows(tmp_path / "out") if row["video_id"] == "clip0"]
    assert [row["frames_scored"] for row in rows] == ["5", "5"]
    near = read_video(tmp_path / "near" / "clip0.mp4").frames
    expected = psnr(near, target_of(metadata, "clip0"))[1:6].mean()
    assert float(rows[0]["psnr"]) == pytest.approx(expected)


def test_dwm_counts_frame_0_and_one_error_a_clip(metadata, folders, tmp_path, capsys):
    text = metadata.read_text().replace("egodex", "real_static")
    metadata.write_text(text)
    (tmp_path / "far" / "egodex").rename(tmp_path / "far" / "real_static")
    make(metadata, folders, tmp_path / "out", name="dwm_1", baselines=())
    row = next(row for row in read_rows(tmp_path / "out") if row["video_id"] == "clip0")
    video, target = (
        read_video(path).frames.astype(float)
        for path in (tmp_path / "near" / "clip0.mp4", metadata.parent / "clip0" / "video.mp4")
    )
    expected = 10 * np.log10(255**2 / np.square(video - target).mean())
    assert float(row["psnr_clip"]) == pytest.approx(expected, abs=1e-4)
    assert row["frames_scored"] == "9"
    printed = capsys.readouterr().out
    assert "unavailable: lpips_vgg" in printed  # VGG, which is not installed here
    assert "unavailable: dreamsim: its weights" in printed


def test_a_narrow_border_is_cut_off(metadata, folders, tmp_path):
    target = target_of(metadata, "clip0")
    framed = np.pad(target, ((0, 0), (0, 0), (2, 2), (0, 0)))
    write_video(tmp_path / "near" / "clip0.mp4", framed, 16)
    make(metadata, folders, tmp_path / "out", baselines=())
    assert float(read_rows(tmp_path / "out")[0]["psnr"]) > 30  # resized, it has 19


def test_a_second_run_computes_what_is_new(metadata, folders, tmp_path, monkeypatch):
    make(metadata, folders, tmp_path / "out")
    first = (tmp_path / "out" / "report.json").read_bytes()
    computed = []
    read = scoring.read_at
    monkeypatch.setattr(scoring, "read_at", lambda *a: computed.append(a[0]) or read(*a))
    make(metadata, folders, tmp_path / "out")
    assert not computed
    assert (tmp_path / "out" / "report.json").read_bytes() == first
    write_video(tmp_path / "near" / "clip1.mp4", target_of(metadata, "clip1"), 16)
    make(metadata, folders, tmp_path / "out")
    assert [path.parent.name for path in computed] == ["clip1"]
    assert (tmp_path / "out" / "report.json").read_bytes() != first


def test_differences_are_paired_with_the_first_folder(metadata, folders, tmp_path):
    make(metadata, folders, tmp_path / "out", baselines=())
    rows = {(r["video_id"], r["method"]): float(r["psnr"]) for r in read_rows(tmp_path / "out")}
    expected = [rows[f"clip{n}", "Far"] - rows[f"clip{n}", "near"] for n in range(2)]
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    found = report["differences"]["egodex"]["Far"]["psnr"]
    assert found["mean"] == pytest.approx(np.mean(expected))
    half = 12.7062 * np.std(expected, ddof=1) / 2**0.5  # Student's t of 1 degree of freedom
    ends = np.mean(expected) - half, np.mean(expected) + half
    assert (found["low"], found["high"]) == pytest.approx(ends)
    assert "egovid" not in report["differences"]  # of one clip


def test_windows_of_one_clip_are_summarized_by_their_order(metadata, folders, tmp_path, capsys):
    near = tmp_path / "near"
    lines = []
    for name in ("clip0", "clip1"):
        for place, start in enumerate((0, 4)):
            target = target_of(metadata, name)[start : start + 5]
            write_video(near / f"{name}_{start}.mp4", target // (2 + place), 16)
            line = {"video_id": f"{name}_{start}", "source_id": name, "start": start}
            lines.append({**line, "status": "done"})
    (near / "results.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    make(metadata, folders[:1], tmp_path / "out", name="egosim_continuous", baselines=())
    first, second = json.loads((tmp_path / "out" / "report.json").read_text())["by_index"]["near"]
    assert first["clips"] == second["clips"] == 2
    assert first["psnr"]["mean"] > second["psnr"]["mean"]
    assert "decay by clip" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["egosim", "dwm_4"])
def test_every_table_writes_all_of_its_files(metadata, folders, tmp_path, name):
    group = next(iter(TABLES[name].groups))
    text = metadata.read_text().replace("egodex", "other").replace("egovid", group)
    metadata.write_text(text)
    make(metadata, folders[:1], tmp_path / "out", name=name, baselines=(), page_clips=1)
    out = tmp_path / "out"
    assert json.loads((out / "report.json").read_text())["splits"][group]["near"]["clips"] == 1
    assert len(read_rows(out)) == 1
    assert TABLES[name].groups[group] in (out / "table.tex").read_text()
    assert (out / "scores.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "index.html").read_text()
    assert "data:video/mp4;base64" in page
    assert all(title in page for title in TABLES[name].published.get(group, {}))


def test_the_command_knows_every_table():
    assert set(TABLES) == set(Name.__args__)


@pytest.mark.parametrize(
    ("given", "where", "option"),
    [
        (("a/../x y",), None, "--generated"),
        (("A=none",), None, "--generated"),
        (("near", "near"), None, "--generated"),
        (("near",), "dataset=other", "--metadata"),
    ],
)
def test_wrong_folders_and_rows_are_refused(metadata, folders, tmp_path, given, where, option):
    given = tuple(folders[0] if name == "near" else name for name in given)
    with pytest.raises(InputError, match=rf"\({option}\)"):
        make(metadata, given, tmp_path / "out", where=where)
