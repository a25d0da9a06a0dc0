"""Shards on an object store: a local server of S3's protocol, whose transfers break on demand."""

import json
import os
import socket
import sys
from collections import Counter
from pathlib import Path

import fsspec
import numpy as np
import pytest
from moto.server import ThreadedMotoServer
from s3fs import S3FileSystem

from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.mixing import MIXTURE, open_shards
from egosim_jax.data.shards import ShardReader
from egosim_jax.data.stores import local_shards
from egosim_jax.runtime.command import ExitCode, ProcessExit
from egosim_jax.types import InputError
from tests.unit.data.latent_records import write_latents

SECRET = "cXVpdGUgc2VjcmV0"  # noqa: S105


class Broken:
    """The application of a server: it counts requests, and breaks or refuses some."""

    def __init__(self, app):
        self.app, self.asked, self.cut = app, Counter(), 0

    def __call__(self, environ, start_response):
        path = environ["PATH_INFO"]
        if path.startswith("/private/"):
            start_response("403 Forbidden", [("Content-Type", "application/xml")])
            return [b"<Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>"]
        if environ["REQUEST_METHOD"] == "GET":
            self.asked[Path(path).name] += 1
            if path.endswith(".array_record") and self.cut:
                self.cut -= 1
                return self.half(environ, start_response)
        return self.app(environ, start_response)

    def half(self, environ, start_response):
        """Half of a body, whose connection then breaks."""
        body = b"".join(self.app(environ, start_response))
        yield body[: len(body) // 2]
        environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
        raise ConnectionResetError


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_latents(tmp_path_factory.mktemp("local") / "latents")


@pytest.fixture(scope="module")
def server(dataset):
    """A server with the dataset at s3://bucket/data/latents; its application."""
    moto = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    moto.start()
    host, port = moto.get_host_and_port()
    moto._server.app = app = Broken(moto._server.app)
    names = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "id",
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in names.items():
            patch.setenv(name, value)
        files = S3FileSystem(skip_instance_cache=True)
        files.mkdir("bucket")
        files.put(f"{dataset}/", "bucket/data/latents/", recursive=True)
        app.files = files
        yield app
    moto.stop()


@pytest.fixture(autouse=True)
def _whole(server):
    """Forget the requests and faults of other tests."""
    server.asked.clear()
    server.cut = 0


ADDRESS = "s3://bucket/data/latents"


def assert_equal_records(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.metadata == other.metadata
        assert one.arrays.keys() == other.arrays.keys()
        for name, array in one.arrays.items():
            np.testing.assert_array_equal(array, other.arrays[name])


def shards_asked(server):
    return sum(count for name, count in server.asked.items() if name.endswith(".array_record"))


def test_a_folder_is_read_where_it_is(dataset):
    assert local_shards(dataset) == local_shards(str(dataset)) == dataset


def test_the_records_are_those_of_the_folder(server, dataset, tmp_path):
    folder = local_shards(ADDRESS, cache=tmp_path)
    assert folder == tmp_path / "s3" / "bucket" / "data" / "latents"
    assert_equal_records(ShardReader(folder), ShardReader(dataset))


def test_a_second_start_copies_only_what_is_missing(server, tmp_path):
    folder = local_shards(ADDRESS, cache=tmp_path)
    server.asked.clear()
    assert local_shards(f"{ADDRESS}/", cache=tmp_path) == folder
    assert server.asked == {MANIFEST: 1}
    (folder / "shard-00001.array_record").unlink()
    (folder / MANIFEST).unlink()  # as after a crash: it is written last
    local_shards(ADDRESS, cache=tmp_path)
    assert server.asked == {MANIFEST: 2, "shard-00001.array_record": 1}


def test_a_changed_dataset_replaces_the_copy(server, tmp_path):
    place = "bucket/changing"
    server.files.put(f"{write_latents(tmp_path / 'one')}/", f"{place}/", recursive=True)
    folder = local_shards(f"s3://{place}", cache=tmp_path / "cache")
    before = len(list(folder.glob("*.array_record")))
    manifest = json.loads((folder / MANIFEST).read_text())
    other = tmp_path / "other"
    write_latents(other, records=2)
    server.files.put(f"{other}/", f"{place}/", recursive=True)
    assert local_shards(f"s3://{place}", cache=tmp_path / "cache") == folder
    assert_equal_records(ShardReader(folder), ShardReader(other))
    assert len(list(folder.glob("*.array_record"))) < before
    assert json.loads((folder / MANIFEST).read_text()) != manifest


def test_a_mixture_is_copied_with_its_parts(server, dataset, tmp_path):
    parts = {"parts": [{"shards": "../data/latents", "weight": 1.0}]}
    server.files.pipe(f"bucket/mix/{MIXTURE}", json.dumps(parts).encode())
    mixture = open_shards(local_shards("s3://bucket/mix", cache=tmp_path))
    assert_equal_records(mixture, ShardReader(dataset))


@pytest.mark.parametrize("name", ["../../other/latents", "/etc", "../../../.."])
def test_a_mixture_reads_no_folder_outside_its_bucket(server, tmp_path, name):
    parts = {"parts": [{"shards": name, "weight": 1.0}]}
    server.files.pipe(f"bucket/bad/{MIXTURE}", json.dumps(parts).encode())
    with pytest.raises(InputError, match="must be in its bucket"):
        local_shards("s3://bucket/bad", cache=tmp_path)


def test_a_broken_transfer_is_repeated(server, dataset, tmp_path):
    server.cut = 2
    folder = local_shards(ADDRESS, cache=tmp_path)
    assert server.cut == 0
    assert_equal_records(ShardReader(folder), ShardReader(dataset))


def test_transfers_that_break_always_end_with_a_code_to_run_again(server, tmp_path):
    server.cut = 10**6
    with pytest.raises(ProcessExit, match="Run the same command again") as caught:
        local_shards(ADDRESS, cache=tmp_path)
    assert caught.value.code == ExitCode.RESUBMIT
    assert not [*tmp_path.rglob("*.array_record"), *tmp_path.rglob(MANIFEST)]


def test_a_shard_of_other_bytes_is_refused(server, dataset, tmp_path):
    server.files.put(f"{dataset}/", "bucket/damaged/", recursive=True)
    size = (dataset / "shard-00000.array_record").stat().st_size
    for count in (size, size + 1):
        server.files.pipe("bucket/damaged/shard-00000.array_record", os.urandom(count))
        with pytest.raises(InputError, match="differs from its manifest"):
            local_shards("s3://bucket/damaged", cache=tmp_path)
    server.files.rm("bucket/damaged/shard-00000.array_record")
    with pytest.raises(InputError, match="is missing, although its manifest names it"):
        local_shards("s3://bucket/damaged", cache=tmp_path)


@pytest.mark.parametrize(
    "address",
    [
        "s3://nowhere/latents", "s3://bucket/nothing", "s3://private/latents", "s3://bucket/../x",
        "s3://id:secret@bucket/x", "none://bucket/x", "http://127.0.0.1/x::memory://y",
    ],
)  # fmt: skip
def test_an_address_without_shards_is_refused(server, tmp_path, address):
    with pytest.raises(InputError) as caught:
        local_shards(address, cache=tmp_path)
    assert SECRET not in str(caught.value)
    assert shards_asked(server) == 0


def test_more_than_the_limit_is_refused_before_it_is_copied(server, tmp_path):
    with pytest.raises(InputError, match=r"of at most 1e-05 GB.*--cache-gb"):
        local_shards(ADDRESS, cache=tmp_path, limit=10_000)
    assert shards_asked(server) == 0


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(InputError, match=r"gcsfs.*egosim-jax\[stores\]"):
        local_shards("gs://bucket/latents", cache=tmp_path)


def test_every_store_of_fsspec_is_read(dataset, tmp_path):
    files = fsspec.filesystem("memory")
    files.put(f"{dataset}/", "/bucket/latents/", recursive=True)
    folder = local_shards("memory://bucket/latents", cache=tmp_path)
    assert_equal_records(ShardReader(folder), ShardReader(dataset))
