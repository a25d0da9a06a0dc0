"""Downloads of releases: pinned, continued and verified, from a hub on the loopback."""

import hashlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from huggingface_hub.errors import OfflineModeIsEnabled

from egosim_jax.io import hub
from egosim_jax.io.bounded import read_json
from egosim_jax.types import InputError
from tests.hub import COMMIT, Hub, serve

RELEASE = hub.Release(
    name="some_model",
    about="a test",
    config="debug",
    repository="someone/some-model",
    revision=None,
    widen=None,
    files={"weights.bin": None, "tokenizer/*": None},
)


@pytest.fixture
def served(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "hub"
    (folder / "tokenizer").mkdir(parents=True)
    (folder / "weights.bin").write_bytes(np.random.default_rng(0).bytes(3_000_000))
    (folder / "tokenizer" / "tokenizer.json").write_text("{}")
    (folder / "model.py").write_text("raise SystemExit")
    with serve(Hub(folder, RELEASE.repository), monkeypatch) as running:
        yield running


def fetch(release, folder):
    return hub.download(hub.list_files(release)[0], folder)


def test_only_the_files_of_the_release_are_downloaded_and_their_hashes_recorded(served, tmp_path):
    hashes = fetch(RELEASE, tmp_path / "here").files
    names = {p.name for p in (tmp_path / "here").iterdir() if not p.name.startswith(".")}
    assert names == {"weights.bin", "tokenizer"}
    data = (served.folder / "weights.bin").read_bytes()
    assert (tmp_path / "here" / "weights.bin").read_bytes() == data
    assert hashes["weights.bin"] == hashlib.sha256(data).hexdigest()
    record = read_json(hub.record_path(RELEASE.name))
    assert record["revision"] == COMMIT
    assert record["files"]["tokenizer/tokenizer.json"] == hashlib.sha256(b"{}").hexdigest()
    served.requests.clear()
    fetch(RELEASE, tmp_path / "here")
    assert not [path for method, path, _ in served.requests if "resolve" in path]


def test_a_download_that_was_cut_off_continues_after_its_bytes(served, tmp_path):
    served.cut.add("weights.bin")
    fetch(RELEASE, tmp_path / "here")
    ranges = [r for method, path, r in served.requests if "weights.bin" in path and r]
    assert ranges == ["bytes=1500000-"]


def test_a_damaged_file_is_removed_and_named(served, tmp_path):
    release, _ = hub.list_files(RELEASE)
    hub.download(release, tmp_path / "here")
    path = tmp_path / "here" / "weights.bin"
    data = bytearray(path.read_bytes())
    data[7] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"weights\.bin has SHA-256 [0-9a-f]{64}; expected"):
        hub.download(release, tmp_path / "here")
    assert not path.exists()
    hub.download(release, tmp_path / "here")
    assert path.read_bytes() == (served.folder / "weights.bin").read_bytes()


def test_the_first_fetch_pins_the_commit(served, tmp_path):
    fetch(RELEASE, tmp_path / "here")
    served.commit = "f" * 40
    with pytest.raises(InputError, match="cannot be downloaded"):
        fetch(RELEASE, tmp_path / "there")
    hub.record_path(RELEASE.name).unlink()
    assert hub.list_files(RELEASE)[0].revision == "f" * 40


def test_a_file_that_the_first_fetch_hashed_must_stay_the_same(served, tmp_path):
    fetch(RELEASE, tmp_path / "here")
    (served.folder / "tokenizer" / "tokenizer.json").write_text("[]")
    with pytest.raises(InputError, match=r"tokenizer\.json has SHA-256"):
        fetch(RELEASE, tmp_path / "there")


def test_a_hub_that_fails_after_its_listing_leaves_no_incomplete_download(
    served, tmp_path, monkeypatch
):
    def fail(*args, **options):
        raise OfflineModeIsEnabled("the network is gone")

    release, _ = hub.list_files(RELEASE)
    (tmp_path / "here" / "tokenizer").mkdir(parents=True)
    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_tree", fail)
    with pytest.raises(InputError, match=r"cannot be downloaded.*Run the same command again"):
        hub.download(release, tmp_path / "here")
    assert not hub.record_path(RELEASE.name).exists()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"files": {"weights.bin": "0" * 64}}, f"expected {'0' * 64}"),
        ({"files": {"other.bin": None}}, r"no file other\.bin.*egosim convert weights FOLDER"),
        ({"repository": "someone/else"}, "someone/else cannot be downloaded"),
    ],
    ids=["hash", "missing", "unreachable"],
)
def test_a_hub_without_the_release_is_one_message(served, change, reason):
    with pytest.raises(InputError, match=reason) as refused:
        hub.list_files(replace(RELEASE, **change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "release", "reason"),
    [
        ("../weights.bin", RELEASE, "not a file that can be downloaded safely"),
        ("/etc/weights.bin", RELEASE, "not a file that can be downloaded safely"),
        ("a/.hidden/weights.bin", RELEASE, "not a file that can be downloaded safely"),
        ("a", replace(RELEASE, revision="f" * 40), f"commit {COMMIT} .* expected {'f' * 40}"),
    ],
)
def test_what_a_hub_lists_is_checked(name, release, reason, monkeypatch, served):
    sibling = SimpleNamespace(rfilename=name, size=1, lfs=None)
    info = SimpleNamespace(sha=COMMIT, siblings=[sibling])
    monkeypatch.setattr("huggingface_hub.HfApi.model_info", lambda *args, **options: info)
    with pytest.raises(InputError, match=reason):
        hub.list_files(replace(release, files={"*weights.bin": None}))


def test_text_of_the_hub_is_escaped_and_cut_in_messages(served, monkeypatch):
    def fail(*args, **options):
        raise ValueError("\x1b[31m" + 1000 * "x")

    monkeypatch.setattr("huggingface_hub.HfApi.model_info", fail)
    with pytest.raises(InputError) as refused:
        hub.list_files(RELEASE)
    assert "\x1b" not in str(refused.value)
    assert len(str(refused.value)) < 400


def test_a_record_that_is_damaged_or_of_another_repository_is_refused(served, tmp_path):
    fetch(RELEASE, tmp_path / "here")
    with pytest.raises(InputError, match="records a fetch from 'someone/some-model'"):
        hub.list_files(replace(RELEASE, repository="someone/else"))
    hub.record_path(RELEASE.name).write_text('{"revision": "main", "files": {}}')
    with pytest.raises(InputError, match="not a record of a fetched release"):
        hub.list_files(RELEASE)


def test_too_little_disk_space_is_found_before_the_download(tmp_path, monkeypatch):
    monkeypatch.setattr(hub, "free_space", lambda folder: 10**9)
    with pytest.raises(InputError, match=r"has 1\.0 GB free, and 2\.5 GB are needed"):
        hub.check_space(2_500_000_000, tmp_path)


def test_an_incomplete_network_counts_as_disk_space_that_is_there(tmp_path):
    (tmp_path / "vae.safetensors").write_bytes(bytes(10**6))  # of an earlier conversion
    assert hub.bytes_needed(10**6, tmp_path) == 2 * 10**6
    (tmp_path / hub.DOWNLOADS).mkdir()
    (tmp_path / hub.DOWNLOADS / "vae.pth").write_bytes(bytes(500_000))
    (tmp_path / "dit.safetensors.0.part").write_bytes(bytes(100_000))
    assert hub.bytes_needed(10**6, tmp_path) == 400_000
