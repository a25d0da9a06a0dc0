"""Manifests describe the records, and changed ones are refused."""

import json

import numpy as np
import pytest

from egosim_jax.data.manifest import MANIFEST, SEAL, read_manifest
from egosim_jax.data.shards import ShardWriter
from egosim_jax.types import InputError
from tests.unit.data.latent_records import SPEC, rewrite_manifest


def test_the_manifest_describes_the_records(folder):
    manifest = read_manifest(folder)
    assert (manifest.kind, manifest.spec, manifest.provenance) == ("latents", SPEC, {"vae": "abc"})
    assert manifest.arrays["target"].dtype == "bfloat16"
    assert manifest.arrays["target"].shape == (3, 4, 6, 16)


def test_axes_on_which_records_differ_are_none(tmp_path):
    with ShardWriter(tmp_path, kind="videos") as writer:
        writer.add({"x": np.zeros((2, 3), np.uint8)}, {"video_id": "a"})
        writer.add({"x": np.zeros((2, 5), np.uint8)}, {"video_id": "b"})
        writer.add({"x": np.zeros((2, 3), np.uint8)}, {"video_id": "c"})
    assert read_manifest(tmp_path).arrays["x"].shape == (2, None)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda fields: fields.update(version=2), "version 2"),
        (lambda fields: fields.update(kind="pickles"), "kind 'pickles'"),
        (lambda fields: fields.pop("shards"), "is not a manifest"),
        (lambda fields: fields.pop("grid"), "is not a manifest"),
        (lambda fields: fields.update(shards=[]), "at least one record"),
        (lambda fields: fields["shards"][0].update(records=0), "at least one record"),
        (lambda fields: fields["spec"].update(frames=10), "4k[+]1"),
        (lambda fields: fields["spec"].update(run="rm"), "is not a manifest"),
        (lambda fields: fields.update(arrays=3), "is not a manifest"),
        (lambda fields: fields["shards"][0].update(records="4"), "is not a manifest"),
        (lambda fields: fields["shards"][0].update(size=1e300), "is not a manifest"),
        (lambda fields: fields["shards"].append(fields["shards"][0]), "must list unique shards"),
        (lambda fields: fields["arrays"]["target"].update(shape=["x"]), "is not a manifest"),
        (lambda fields: fields["arrays"]["target"].update(dtype=["x"]), "is not a manifest"),
        (lambda fields: fields["spec"].update(frames="9"), "of the spec is not an integer"),
        (lambda fields: fields.update(provenance=[]), "is not a manifest"),
        (lambda fields: fields.update(kind=["latents"]), "kind"),
        (lambda fields: fields.update(version=[1]), "version"),
        (lambda fields: fields.update(spec=[1]), "is not a manifest"),
    ],
)
def test_a_bad_manifest_is_refused(folder, change, message):
    rewrite_manifest(folder, change)
    with pytest.raises(InputError, match=message):
        read_manifest(folder)


@pytest.mark.parametrize(
    "change",
    [
        lambda fields: fields["provenance"].update(vae="abd"),
        lambda fields: fields["shards"][0].update(sha256="0" * 64),
        lambda fields: fields["spec"].update(frames=13),
        lambda fields: fields["arrays"]["target"].update(shape=[None]),
        lambda fields: fields["shards"].reverse(),
        lambda fields: fields.pop(SEAL),
    ],
)
def test_a_changed_manifest_is_named(folder, change):
    fields = json.loads((folder / MANIFEST).read_text())
    change(fields)
    (folder / MANIFEST).write_text(json.dumps(fields))
    with pytest.raises(InputError, match="was modified after it was written"):
        read_manifest(folder)


@pytest.mark.parametrize("text", ["{", "[]", "3", '{"version": 1}', "[" * 100_000, "\ud800"])
def test_an_invalid_manifest_is_refused(folder, text):
    (folder / MANIFEST).write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(InputError):
        read_manifest(folder)
