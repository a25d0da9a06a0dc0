"""EgoSim-14B on the one GPU that is there: seconds, TFLOP/s and memory.

    python -m tests.benchmarks.bench_gpu parts                       what the device can do
    python -m tests.benchmarks.bench_gpu forward --layers 40 --kernels cudnn
    python -m tests.benchmarks.bench_gpu step --layers 18 --remats full attention
    python -m tests.benchmarks.bench_gpu forward --weights-8bit float8 --activations-8bit
    python -m tests.benchmarks.bench_gpu step --recipe egosim_14b_lora --remats full
    python -m tests.benchmarks.bench_gpu clip
    python -m tests.benchmarks.bench_gpu sample --steps 6            with fewer FLOPs a clip
    python -m tests.benchmarks.bench_gpu stream                      seconds of a student's chunk
    python -m tests.benchmarks.bench_gpu stream --target h200:8      the same, predicted
    python -m tests.benchmarks.bench_gpu stream --config debug --chunks 2 1  a trial on a CPU
    python -m tests.benchmarks.bench_gpu all --out runs/gpu.jsonl    the main ones, within 9 minutes

All of it at full width and with 24,960 tokens, on random weights. TFLOP/s and MFU count what the
model needs (`forward_flops` of its config), without recomputation. `--profile` says where the
time of the last case went, kernel by kernel. The memory that was taken is compared with what the
program was compiled to take.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig
from egosim_jax.generation.encoding import batch_shapes
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models import eight_bit
from egosim_jax.models.attention import attention
from egosim_jax.models.layers import init_sharded
from egosim_jax.models.wan.dit import WanDiT
from egosim_jax.preflight.report import compile_for
from egosim_jax.preflight.targets import GIB, compile_offline, find
from egosim_jax.sharding import batch_sharding, make_mesh
from egosim_jax.train import recipes
from egosim_jax.train.task import Stage
from egosim_jax.train.update import Programs
from egosim_jax.types import MeshConfig
from tests.benchmarks.gpu import compile_all, draw, draw_generator, half, speed, taken, tera, timed
from tests.benchmarks.gpu_sampling import sample
from tests.benchmarks.gpu_stream import stream

BFLOAT16 = 4e-3
"""Relative error that a kernel may have."""
TOKENS, HEADS, WIDTH, MLP, IMAGE = 24960, 40, 5120, 13824, 257


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=[*MEASURES, "all"])
    parser.add_argument("--config", default="egosim_14b")
    parser.add_argument("--layers", type=int, help="fewer blocks than the model has")
    parser.add_argument("--kernels", nargs="+", default=["cudnn"])
    parser.add_argument("--remats", nargs="+", default=["full"])
    parser.add_argument("--clips", type=int, default=1)
    parser.add_argument("--steps", type=int, help="denoising steps: 50, or 2 for a student")
    parser.add_argument("--chunks", type=int, nargs="+", default=[4, 4, 4, 4])
    parser.add_argument("--first-steps", type=int, help="steps of the first chunk")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--target", help="only compile, for this: what the preflight predicts")
    parser.add_argument("--recipe", default="egosim_14b", help="of the step; its model is --config")
    parser.add_argument("--weights-8bit", choices=["float8"], help="of the forward")
    parser.add_argument("--activations-8bit", action="store_true")
    parser.add_argument("--limit-s", type=float, default=530, help="of all")
    parser.add_argument("--out", type=Path, help="file to which all appends each line")
    options = parser.parse_args()
    if options.what == "all":
        run_all(options)
        return
    if options.target is not None:
        compile_offline()
    else:
        device = jax.devices()[0]
        print(f"{device.device_kind}, jax {jax.__version__}", flush=True)
    for line in MEASURES[options.what](options):
        print(json.dumps(line), flush=True)


def parts(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The kernels that a block consists of, one by one, forward and backward."""
    one = lambda *shape: jax.random.normal(jax.random.key(len(shape)), shape, jnp.bfloat16)  # noqa: E731
    x = one(1, TOKENS, WIDTH)
    for name, inner, outer in (("square", WIDTH, WIDTH), ("up", WIDTH, MLP), ("down", MLP, WIDTH)):
        a, w = one(TOKENS, inner), one(inner, outer)
        seconds = _seconds(jax.jit(jnp.matmul), (a, w), options.repeats)
        yield {
            "part": name,
            "ms": seconds * 1e3,
            "tflops": tera(2 * TOKENS * inner * outer, seconds),
        }
    q, k, v, g = (one(1, TOKENS, HEADS, WIDTH // HEADS) * (1 + i / 8) for i in range(4))
    flops = 4 * TOKENS**2 * WIDTH
    some = slice(None, None, TOKENS // 64)
    with jax.default_matmul_precision("highest"):
        exact = attention(*(x.astype(jnp.float32) for x in (q[:, some], k, v)))
    for kernel in options.kernels:
        attend = jax.jit(lambda q, k, v, kernel=kernel: attention(q, k, v, kernel=kernel))
        seconds = _seconds(attend, (q, k, v), options.repeats)
        error = jnp.linalg.norm(attend(q, k, v)[:, some] - exact) / jnp.linalg.norm(exact)
        if not error < BFLOAT16:
            raise SystemExit(f"{kernel} is {error:.1e} from what float32 gives.")
        yield {
            "part": f"{kernel} forward",
            "ms": seconds * 1e3,
            "tflops": tera(flops, seconds),
            "error": float(error),
        }

        def both(q: Any, k: Any, v: Any, g: Any, kernel: Any = kernel) -> Any:
            return jax.vjp(lambda *qkv: attention(*qkv, kernel=kernel), q, k, v)[1](g)

        both_s = _seconds(jax.jit(both), (q, k, v, g), options.repeats)
        yield {
            "part": f"{kernel} forward and backward",
            "ms": both_s * 1e3,
            "tflops backward": tera(2.5 * flops, both_s - seconds),
        }
    copied = _seconds(jax.jit(lambda x: x + 1), (jnp.tile(x, (8, 1, 1)),), options.repeats)
    yield {"part": "copy", "terabytes_s": 2 * 8 * x.nbytes / copied / 1e12}


def forward(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A forward of the transformer, in bfloat16 with bfloat16 weights."""
    for kernel in options.kernels:
        config = _model(options, kernel, "none")
        network = nnx.eval_shape(lambda c=config: WanDiT(c.dit, rngs=nnx.Rngs(0)))
        if options.weights_8bit is not None:
            layers = eight_bit.layers_of(flat_shapes(network))
            kinds = dict.fromkeys(layers, eight_bit.DTYPES[options.weights_8bit])
            eight_bit.adapt(network, kinds, activations=options.activations_8bit)
        graph, params = nnx.split(network)
        dit = config.dit
        size = (*config.latent_shape, dit.in_channels)
        shapes = (
            jax.ShapeDtypeStruct((options.clips, *size), jnp.bfloat16),
            jax.ShapeDtypeStruct((options.clips,), jnp.float32),
            jax.ShapeDtypeStruct(
                (options.clips, config.tokenizer.max_tokens, dit.text_dim), "bfloat16"
            ),
            jax.ShapeDtypeStruct((options.clips, IMAGE, dit.image_dim), "bfloat16"),
        )
        mesh = make_mesh(MeshConfig(), _devices(options))
        run = jax.jit(
            lambda p, *x, graph=graph: nnx.merge(graph, p)(*x), in_shardings=batch_sharding(mesh)
        )
        needed = options.clips * _forward_flops(config)
        args = (half(params), *shapes)
        with jax.set_mesh(mesh):
            line = {"kernel": kernel, "layers": dit.layers}
            if options.weights_8bit is not None:
                line |= {"weights": options.weights_8bit, "activations": options.activations_8bit}
            yield from _measure(options, run, args, needed, line)


def step(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A whole update of a recipe, of all weights or of a LoRA: AdamW, clipping, float32 weights."""
    for kernel in options.kernels:
        for remat in options.remats:
            stage = _stage(options.recipe, _model(options, kernel, remat), options.clips)
            mesh = make_mesh(stage.training.mesh, _devices(options))
            programs = Programs.of(*stage, mesh)
            batch = stage.task.shapes(options.clips)
            with jax.set_mesh(mesh):
                yield from _measure(
                    options,
                    programs.update,
                    (programs.state, programs.frozen, batch),
                    stage.task.flops(options.clips),
                    {"kernel": kernel, "remat": remat, "layers": stage.task.model.dit.layers},
                    make=lambda programs=programs: init_sharded(
                        programs.create, out_shardings=programs.state_sharding
                    ),
                )


def clip(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """All of EgoSim-14B: conditions encoded, 50 steps, decoded, with all networks on the device."""
    steps = options.steps or 50
    config = replace(configs.get(options.config), steps=steps)
    line: dict[str, Any] = {}
    generator = draw_generator(config, line)
    programs = {name: program for name, program, _ in compile_all(generator, options.clips, line)}
    yield line
    inputs = draw(batch_shapes(options.clips, config))
    seeds = jnp.arange(options.clips, dtype=jnp.uint32)
    needed = options.clips * steps * _forward_flops(config)
    for attempt in range(options.repeats):
        line = {"clip": attempt, "steps": steps}
        condition = timed(line, "encode_s", lambda: programs["encode"](inputs))
        noise = timed(line, "noise_s", lambda: programs["noise"](seeds))
        latents = timed(line, "denoise_s", lambda c=condition, n=noise: programs["denoise"](c, n))
        frames = timed(line, "decode_s", lambda x=latents: programs["decode"](x))
        finite = bool(jnp.isfinite(latents).all()) and int(frames.max()) > int(frames.min())
        yield {
            **line,
            "step_s": line["denoise_s"] / steps,
            **speed(needed, line["denoise_s"]),
            "peak_gib": taken(),
            "finite": finite,
        }
    if options.profile:
        condition, noise = programs["encode"](inputs), programs["noise"](seeds)
        given_to = {"encode": (inputs,), "decode": (latents,), "denoise": (condition, noise)}
        for name, given in given_to.items():
            with _profile() as kernels:
                jax.block_until_ready(programs[name](*given))
            yield {"profile of": name}
            yield from kernels


def run_all(options: argparse.Namespace) -> None:
    """Run the cases one after the other, each in a separate process, until the time is over.

    A case that fails does not stop the others. One that would not end in time is skipped.
    """
    end = time.monotonic() + options.limit_s
    common = ["--config", options.config, *(["--target", options.target] if options.target else [])]
    for words, seconds in CASES:
        left = end - time.monotonic()
        command = [sys.executable, "-m", "tests.benchmarks.bench_gpu", *words.split(), *common]
        if left < seconds:
            _note(options.out, {"skipped": words, "needs_s": seconds, "left_s": round(left)})
            continue
        begun = time.monotonic()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            killer = threading.Timer(left, process.kill)
            killer.start()
            for text in process.stdout or ():
                measured = text.startswith("{")
                _note(
                    options.out, {"case": words, **json.loads(text)} if measured else text.strip()
                )
            killer.cancel()
        taken_s = round(time.monotonic() - begun, 1)
        _note(options.out, {"case": words, "exit": process.returncode, "taken_s": taken_s})


def _note(out: Path | None, line: Any) -> None:
    """Print a line, and append it to a file at once: what was measured survives a kill."""
    text = line if isinstance(line, str) else json.dumps(line)
    print(text, flush=True)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("a") as file:
            print(text, file=file)


def _measure(
    options: argparse.Namespace,
    run: Any,
    args: tuple,
    needed: float,
    line: dict[str, Any],
    make: Callable[[], Any] | None = None,
) -> Iterator[dict[str, Any]]:
    """Compile for shapes, then draw arguments of these shapes and run; `make` makes the first.

    Each run donates the array, and gets it back as the first result.
    """
    traced = run.trace(*args)
    if options.target is not None:
        report = compile_for(find(options.target), traced, model_flops=needed)
        yield {**line, "preflight_gib": report.memory.peak / GIB, "roofline_s": report.roofline_s}
        return
    begun = time.perf_counter()
    compiled = traced.lower().compile()
    line["compile_s"] = time.perf_counter() - begun
    memory = compiled.memory_analysis()
    line["compiled_gib"] = (
        memory.argument_size_in_bytes
        + memory.output_size_in_bytes
        - memory.alias_size_in_bytes
        + memory.temp_size_in_bytes
    ) / GIB
    if make is None:
        given = draw(args)
        call = lambda: compiled(*given)  # noqa: E731
    else:
        state, rest = [make()], draw(args[1:])

        def call() -> Any:
            state[0], metrics = compiled(state[0], *rest)
            return metrics

    answer = jax.block_until_ready(call())
    seconds = []
    for _ in range(options.repeats):
        begun = time.perf_counter()
        answer = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - begun)
    least = statistics.median(seconds)
    finite = all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(answer))
    yield {
        **line,
        "seconds": least,
        "spread": (max(seconds) - min(seconds)) / least,
        **speed(needed, least),
        "peak_gib": taken(),
        "finite": finite,
    }
    if options.profile:
        with _profile() as kernels:
            jax.block_until_ready(call())
        yield from kernels
    # Leftovers would take memory in the next case.
    if make is not None:
        jax.tree.map(lambda leaf: leaf.delete(), state[0])


def _devices(options: argparse.Namespace) -> Sequence[Any] | None:
    return options.target and find(options.target).devices


def _model(options: argparse.Namespace, kernel: Any, remat: Any) -> ModelConfig:
    config = configs.get(options.config)
    layers = options.layers or config.dit.layers
    return replace(config, dit=replace(config.dit, layers=layers, attention=kernel, remat=remat))


def _stage(recipe: str, model: ModelConfig, clips: int) -> Stage:
    task, training = recipes.RECIPES[recipe][1].stages()["training"]
    training = replace(training, batch_size=clips, grad_accum_steps=1)
    return Stage(replace(task, model=model), training)


def _forward_flops(config: ModelConfig) -> float:
    """Return the inputs of one clip."""
    text, latents = config.tokenizer.max_tokens, config.latent_shape
    return config.dit.forward_flops(latents=latents, text=text, image=IMAGE).total


def _seconds(run: Callable[..., Any], args: tuple, repeats: int) -> float:
    """Median seconds of a call, among several that wait for each other on the device only."""
    jax.block_until_ready(run(*args))
    found = []
    for _ in range(repeats):
        begun = time.perf_counter()
        for _ in range(4):
            answer = run(*args)
        jax.block_until_ready(answer)
        found.append((time.perf_counter() - begun) / 4)
    return statistics.median(found)


@contextmanager
def _profile() -> Iterator[list[dict[str, Any]]]:
    """Fill a list with the kernels that ran meanwhile, those that took longest first."""
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            yield found
        (path,) = Path(folder).rglob("*.xplane.pb")
        data = jax.profiler.ProfileData.from_file(str(path))
        time_ns, count = Counter[str](), Counter[str]()
        for plane in data.planes:
            if not plane.name.startswith("/device:GPU"):
                continue
            for line in plane.lines:
                if not line.name.startswith("Stream"):
                    continue
                for event in line.events:
                    name = re.sub(r"[_.]?\d+$", "", event.name)[:120]
                    time_ns[name] += event.duration_ns
                    count[name] += 1
        total = sum(time_ns.values())
        found.append({"profile": "all kernels", "ms": total / 1e6, "count": sum(count.values())})
        for name, taken in time_ns.most_common(40):
            found.append(
                {
                    "kernel": name,
                    "ms": round(taken / 1e6, 2),
                    "share": round(taken / total, 4),
                    "count": count[name],
                }
            )


MEASURES: Mapping[str, Callable[[argparse.Namespace], Iterator[dict[str, Any]]]] = {
    "parts": parts,
    "forward": forward,
    "step": step,
    "clip": clip,
    "stream": stream,
    "sample": sample,
}
CASES = (
    ("forward --kernels cudnn hopper --repeats 3", 80),
    ("stream --steps 2 --repeats 2", 120),
    ("step --recipe egosim_14b_lora --kernels hopper --remats full --repeats 2", 80),
    ("sample --steps 6", 150),
    ("forward --kernels hopper --weights-8bit float8 --repeats 3", 45),
    ("forward --kernels hopper --weights-8bit float8 --activations-8bit --repeats 3", 45),
)
"""Cases of `all`, with the seconds that each needs at least; the most wanted first."""


if __name__ == "__main__":
    main()
