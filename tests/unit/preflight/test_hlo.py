"""HLO text: of a short module, and of a program that was compiled."""

import jax
import jax.numpy as jnp
import pytest

from egosim_jax.preflight.hlo import HloModule

TEXT = """HloModule jit_f, is_scheduled=true

%add (a: f32[], b: f32[]) -> f32[] {
  %a = f32[] parameter(0)
  %b = f32[] parameter(1)
  ROOT %sum = f32[] add(%a, %b)
}

%fused (p.0: f32[4,8,8], p.1: s32[]) -> f32[8,8] {
  %p.0 = f32[4,8,8]{2,1,0} parameter(0)
  %p.1 = s32[] parameter(1)
  %zero = s32[] constant(0)
  %slice = f32[1,8,8]{2,1,0} dynamic-slice(%p.0, %p.1, %zero, %zero), dynamic_slice_sizes={1,8,8}
  ROOT %layer = f32[8,8]{1,0} bitcast(%slice)
}

%body (state: (s32[], f32[8,8], f32[4,8,8])) -> (s32[], f32[8,8], f32[4,8,8]) {
  %state = (s32[], f32[8,8]{1,0}, f32[4,8,8]{2,1,0}) parameter(0)
  %i = s32[] get-tuple-element(%state), index=0
  %x = f32[8,8]{1,0} get-tuple-element(%state), index=1
  %w = f32[4,8,8]{2,1,0} get-tuple-element(%state), index=2
  %wi = f32[8,8]{1,0} fusion(%w, %i), kind=kLoop, calls=%fused
  %gather = (f32[8,8]{1,0}, f32[16,8]{1,0}) all-gather-start(%wi), replica_groups=[2,2]<=[4]
  %whole = f32[16,8]{1,0} all-gather-done(%gather)
  %y = f32[8,8]{1,0} custom-call(%x, %whole), custom_call_target="matmul"
  %all = f32[8,8]{1,0} all-reduce(%y), replica_groups={{0,1,2,3}}, to_apply=%add
  ROOT %next = (s32[], f32[8,8]{1,0}, f32[4,8,8]{2,1,0}) tuple(%i, %all, %w)
}

%condition (state: (s32[], f32[8,8], f32[4,8,8])) -> pred[] {
  %state.1 = (s32[], f32[8,8]{1,0}, f32[4,8,8]{2,1,0}) parameter(0)
  %i.1 = s32[] get-tuple-element(%state.1), index=0
  %bound = s32[] constant(4)
  ROOT %less = pred[] compare(%i.1, %bound), direction=LT
}

ENTRY %main (x.0: f32[8,8], w.0: f32[4,8,8]) -> f32[8,8] {
  %x.0 = f32[8,8]{1,0} parameter(0), metadata={op_name="x"}
  %w.0 = f32[4,8,8]{2,1,0} parameter(1), metadata={op_name="w"}
  %zero.0 = s32[] constant(0)
  %begin = (s32[], f32[8,8]{1,0}, f32[4,8,8]{2,1,0}) tuple(%zero.0, %x.0, %w.0)
  %loop = (s32[], f32[8,8]{1,0}, f32[4,8,8]{2,1,0}) while(%begin), condition=%condition, body=%body
  ROOT %out = f32[8,8]{1,0} get-tuple-element(%loop), index=1
}
"""
MATRIX = 4 * 8 * 8
"""Bytes of a matrix."""


@pytest.fixture
def module():
    return HloModule.read(TEXT)


def test_a_loop_runs_as_often_as_its_condition_says(module):
    assert module.runs == {"main": 1, "body": 4}


def test_a_loop_runs_as_often_as_the_compiler_says():
    config = 'backend_config={"known_trip_count":{"n":"7"}}'
    text = TEXT.replace("body=%body", f"body=%body, {config}")
    assert HloModule.read(text).runs["body"] == 7


def test_collectives_are_counted_with_their_loops_and_as_sent_in_a_ring(module):
    found = module.collectives()
    assert found.keys() == {"all-gather", "all-reduce"}
    gather, reduce = found["all-gather"], found["all-reduce"]
    assert (gather.count, gather.bytes) == (4, 4 * 2 * MATRIX / 2)
    assert (reduce.count, reduce.bytes) == (4, 4 * 2 * MATRIX * 3 / 4)


@pytest.mark.parametrize(
    ("groups", "devices"),
    [("{{0,1,2,3},{4,5,6,7}}", 4), ("[2,4]<=[8]", 4), ("mesh['a'=2,'b'=4] {'b'}", 4)],
)
def test_groups_of_devices_are_written_in_three_ways(groups, devices):
    text = TEXT.replace("replica_groups={{0,1,2,3}}", f"replica_groups={groups}")
    sent = 4 * 2 * MATRIX * (devices - 1) / devices
    assert HloModule.read(text).collectives()["all-reduce"].bytes == sent


def test_a_fusion_reads_the_slice_that_it_takes(module):
    fusion = 2 * MATRIX + 4  # a matrix in and out, and the index
    gathered, product, summed = 3 * MATRIX, 4 * MATRIX, 2 * MATRIX
    assert module.traffic() == 4 * (fusion + gathered + product + summed)


def test_the_largest_arrays_are_named_by_their_source(module):
    first, *others = module.largest(10)
    assert (first.bytes, first.shape, first.source) == (4 * MATRIX, "f32[4,8,8]", "w")
    assert all(array.bytes <= 2 * MATRIX for array in others)


def test_the_text_of_a_compiled_program_is_parsed():
    def f(x, w):
        return jax.lax.scan(lambda x, w: (jnp.tanh(x @ w), None), x, w)[0]

    compiled = jax.jit(f).lower(jnp.ones((64, 64)), jnp.ones((5, 64, 64))).compile()
    module = HloModule.read(compiled.as_text())
    assert sorted(module.runs.values())[-1] == 5
    assert module.largest(1)[0].bytes == 5 * 64 * 64 * 4
    # Each iteration reads x and a matrix and writes x, slices the matrix, and applies tanh to x.
    assert 5 * 3 * 64 * 64 * 4 <= module.traffic() <= 5 * 9 * 64 * 64 * 4
