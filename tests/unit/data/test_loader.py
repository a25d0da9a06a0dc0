"""The order of the data: by seed alone, shared by processes, resumed exactly."""

import multiprocessing
from contextlib import closing

import grain
import numpy as np
import pytest

from egosim_jax.data.loader import Loader, make_loader, one_pass
from egosim_jax.data.records import to_bytes
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.data.transforms import DecodeWindow
from egosim_jax.runtime.command import ExitCode, ProcessExit
from egosim_jax.types import WAN_GRID, InputError, VideoSpec

RECORDS = 12


@pytest.fixture
def source(tmp_path):
    """Twelve records; each array is filled with the record's number."""
    with ShardWriter(tmp_path / "shards", kind="latents", shard_bytes=2000) as writer:
        for index in range(RECORDS):
            writer.add({"x": np.full((9, 2), index, np.float32)}, {"video_id": f"clip{index}"})
    return ShardReader(tmp_path / "shards")


class Noise(grain.transforms.RandomMap):
    """An example that is a random number."""

    def random_map(self, element, rng):
        return {"noise": rng.random(), "x": element["x"]}


def numbers(loader, batches):
    return [next(loader)["record"].tolist() for _ in range(batches)]


def test_a_batch_stacks_the_records_it_names(source):
    batch = next(make_loader(source, batch_size=4, seed=0))
    assert batch["x"].shape == (4, 9, 2)
    np.testing.assert_array_equal(batch["x"][:, 0, 0], batch["record"])


def test_every_epoch_holds_every_record_once_in_another_order(source):
    loader = make_loader(source, batch_size=RECORDS, seed=0)
    first, second = numbers(loader, 2)
    assert sorted(first) == sorted(second) == list(range(RECORDS))
    assert first != second


def test_a_dead_worker_process_ends_the_loader_with_a_code_to_run_again(source):
    with closing(make_loader(source, batch_size=4, seed=0, workers=1)) as loader:
        next(loader)
        (worker,) = multiprocessing.active_children()
        worker.kill()
        with pytest.raises(ProcessExit, match=r"has died with exit code -9") as caught:
            numbers(loader, 10_000)
    assert caught.value.code == ExitCode.RESUBMIT


def test_the_seed_decides_the_order(source):
    first, again, other = (
        numbers(make_loader(source, batch_size=4, seed=seed), 9) for seed in (7, 7, 8)
    )
    assert first == again != other


@pytest.mark.parametrize(("size", "processes"), [(5, 1), (4, 2), (20, 1), (16, 4), (32, 16)])
def test_one_pass_has_every_record_once_on_as_many_batches_of_all_processes(
    source, size, processes
):
    passes = [
        list(one_pass(source, batch_size=size, rows=range(p, size, processes)))
        for p in range(processes)
    ]
    assert [len(batches) for batches in passes] == [-(-RECORDS // size)] * processes
    batches = [batch for batches in passes for batch in batches]
    assert {len(batch["x"]) for batch in batches} == {size // processes}
    seen = np.concatenate([batch["record"][batch["weight"] == 1] for batch in batches])
    assert sorted(seen) == list(range(RECORDS))


def test_a_global_batch_is_the_same_for_any_number_of_processes(source):
    alone = numbers(make_loader(source, batch_size=4, seed=0), 7)
    shared = [numbers(make_loader(source, batch_size=4, seed=0, rows=[row]), 7) for row in range(4)]
    together = np.concatenate(shared, axis=1).tolist()
    assert together == alone


@pytest.mark.parametrize(
    ("rows", "workers"), [((0, 1, 2, 3), 0), ((0, 3), 0), ((1,), 0), ((1, 2), 1)]
)
def test_any_rows_are_those_of_the_whole_batch_though_records_are_bad(damaged, rows, workers):
    """Also after a resume, from the state of a loader of all rows."""
    whole = make_loader(damaged, batch_size=4, seed=0, transform=Noise())
    state, batches = None, []
    for number in range(10):
        state = whole.get_state() if number == 6 else state
        batches.append(next(whole))
    assert sum(whole.skipped.values()) >= 3
    own = make_loader(damaged, batch_size=4, seed=0, transform=Noise(), rows=rows, workers=workers)
    shares = [next(own) for _ in range(10)]
    own.set_state(state)
    shares += [next(own) for _ in range(4)]
    for share, batch in zip(shares, batches + batches[6:], strict=True):
        for name in ("record", "noise", "x"):
            np.testing.assert_array_equal(share[name], batch[name][list(rows)])
    own.close()


def test_random_numbers_differ_between_epochs(source):
    loader = make_loader(source, batch_size=RECORDS, seed=0, transform=Noise(), shuffle=False)
    assert set(next(loader)["noise"]).isdisjoint(next(loader)["noise"])


@pytest.mark.parametrize("workers", [0, 2])
def test_a_restored_state_gives_the_same_next_100_records(source, workers):
    loader = make_loader(source, batch_size=4, seed=3, workers=workers)
    numbers(loader, 5)
    state = loader.get_state()
    expected = numbers(loader, 25)
    loader.close()
    resumed = make_loader(source, batch_size=4, seed=3, workers=workers)
    resumed.set_state(state)
    assert numbers(resumed, 25) == expected
    resumed.close()


@pytest.mark.parametrize("change", [{"seed": 4}, {"batch_size": 2}, {"shuffle": False}])
def test_a_state_of_another_order_is_refused(source, change):
    state = make_loader(source, batch_size=4, seed=3).get_state()
    other = make_loader(source, **{"batch_size": 4, "seed": 3, **change})
    (name,) = change
    with pytest.raises(InputError, match=f"{name}: the state has"):
        other.set_state(state)
    other.close()


def test_a_state_of_other_records_is_refused(source, tmp_path):
    state = make_loader(source, batch_size=1, seed=3).get_state()
    with ShardWriter(tmp_path / "other", kind="latents") as writer:
        writer.add({"x": np.zeros(3, np.float32)}, {"video_id": "a"})
    with pytest.raises(InputError, match="data: the state has"):
        make_loader(ShardReader(tmp_path / "other"), batch_size=1, seed=3).set_state(state)


@pytest.fixture
def damaged(source):
    """The source with a flipped byte in record 1."""
    path = source.folder / "shard-00000.array_record"
    data = bytearray(path.read_bytes())
    data[data.index(to_bytes(source[1])[100:])] ^= 0xFF
    path.write_bytes(data)
    return ShardReader(source.folder)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_damaged_record_is_replaced_by_the_next_one_counted_and_named(damaged, workers):
    loader = make_loader(damaged, batch_size=4, seed=0, shuffle=False, workers=workers)
    assert numbers(loader, 6) == [
        [0, 2, 2, 3],
        [4, 5, 6, 7],
        [8, 9, 10, 11],
        [0, 2, 2, 3],
        [4, 5, 6, 7],
        [8, 9, 10, 11],
    ]
    ((name, count),) = loader.skipped.items()
    assert name.startswith(str(damaged.folder / "shard-00000.array_record, record 1"))
    assert count == 2
    loader.close()


def test_one_pass_gives_a_damaged_record_no_weight(damaged, caplog):
    first, *_ = one_pass(damaged, batch_size=4)
    assert first["record"].tolist() == [0, 0, 2, 3]
    assert first["weight"].tolist() == [1, 0, 1, 1]
    assert "record 1" in caplog.text


def test_one_pass_over_records_of_which_none_can_be_read_is_refused(source):
    def refuse(arrays):
        raise InputError("no good")

    with pytest.raises(InputError, match=r"(?s)None of the first 12 records.*no good"):
        next(one_pass(source, batch_size=4, transform=refuse))


def test_too_many_damaged_records_stop_the_run_with_their_names(source, monkeypatch):
    def refuse(arrays):
        raise InputError("no good")

    monkeypatch.setattr(Loader, "MAX_BAD", 3)
    loader = make_loader(source, batch_size=4, seed=0, transform=refuse)
    with pytest.raises(InputError, match=r"(?s)Too many.*no good.*no good"):
        next(loader)


def test_a_record_with_nan_or_latents_of_another_length_is_skipped_and_named(tmp_path):
    spec = VideoSpec(frames=5, height=16, width=32)
    latents = np.zeros((*WAN_GRID.latent_shape(spec), 16), np.float32)
    nan, longer = latents.copy(), np.concatenate([latents, latents])
    nan[0, 0, 0, 0] = np.nan
    with ShardWriter(tmp_path, kind="latents", spec=spec) as writer:
        for number, truth in enumerate((latents, nan, longer, latents)):
            writer.add({"target": truth}, {"video_id": f"clip{number}"})
    loader = make_loader(ShardReader(tmp_path), batch_size=2, seed=0, shuffle=False)
    assert numbers(loader, 2) == [[0, 3], [3, 3]]
    reasons = sorted(loader.skipped)
    assert "record 1: target has values that are not finite" in reasons[0]
    assert "record 2: target has (4, 2, 4) latent frames, rows and columns" in reasons[1]
    assert "expected (2, 2, 4)" in reasons[1]


def test_a_mistake_in_a_transform_is_not_taken_for_a_bad_record(source):
    loader = make_loader(source, batch_size=4, seed=0, transform=lambda arrays: arrays["typo"])
    with pytest.raises(KeyError, match="typo"):
        next(loader)


@pytest.mark.parametrize("rows", [(), (5,), (-1, 2), (2, 1), (1, 1)])
def test_rows_that_a_batch_does_not_have_are_refused(source, rows):
    with pytest.raises(InputError, match=r"A batch of 5 has no rows.*from 0 to 4"):
        make_loader(source, batch_size=5, seed=0, rows=rows)
    with pytest.raises(InputError, match=r"A batch of 5 has no rows.*from 0 to 4"):
        next(one_pass(source, batch_size=5, rows=rows))


def test_a_window_is_cut_from_all_videos_alike(tmp_path):
    frames = np.arange(9, dtype=np.uint8)[:, None, None, None]
    video = np.broadcast_to(frames, (9, 16, 16, 3))
    arrays = {"target": video, "prior": video + 20, "hands": video + 40, "mask": video[..., 0] + 60}
    with ShardWriter(tmp_path, kind="frames") as writer:
        writer.add({**arrays, "first_frame": video[0] + 99}, {"video_id": "a"})
    spec = VideoSpec(frames=5, height=16, width=16)
    loader = make_loader(ShardReader(tmp_path), batch_size=1, seed=0, transform=DecodeWindow(spec))
    starts = set()
    for _ in range(40):
        batch = next(loader)
        start = int(batch["target"][0, 0, 0, 0, 0])
        starts.add(start)
        for name, offset in (("target", 0), ("prior", 20), ("hands", 40), ("mask", 60)):
            window = batch[name][0, :, 0, 0].reshape(5, -1)[:, 0]
            np.testing.assert_array_equal(window, np.arange(start, start + 5) + offset)
        assert (batch["first_frame"] == 99).all()
    assert starts == {0, 1, 2, 3, 4}
