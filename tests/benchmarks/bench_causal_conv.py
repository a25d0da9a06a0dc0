"""Times the forms of the causal convolution: `python -m tests.benchmarks.bench_causal_conv`.

`convolve` takes `by_image` on a CPU and `direct` elsewhere. The shapes occur in a video VAE
of width 24 on two clips of 17 frames, 64 x 64, from full resolution down, and its two ends.
"""

import time

import jax
from rich.console import Console
from rich.table import Table

from egosim_jax.models.causal_conv import by_image, direct, sum_of_images

FORMS = (direct, sum_of_images, by_image)
SHAPES = (
    ((2, 17, 64, 64, 3), 24),
    ((2, 17, 64, 64, 24), 24),
    ((2, 17, 64, 64, 24), 3),
    ((1, 17, 96, 160, 24), 24),
    ((2, 17, 32, 32, 48), 48),
    ((2, 9, 16, 16, 96), 96),
    ((2, 5, 8, 8, 96), 96),
)
REPEATS = 5


def milliseconds(program, *arguments):
    """The least time of a few runs, after one that compiles."""
    jax.block_until_ready(program(*arguments))
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        times.append(time.perf_counter() - start)
    return 1000 * min(times)


def measure(form, shape, out_dim):
    """Milliseconds of `form` alone, and of it with both gradients."""
    (b, f, h, w, c), keys = shape, jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], (b, f + 2, h, w, c))
    kernel = jax.random.normal(keys[1], (3, 3, 3, c, out_dim))
    dy = jax.random.normal(keys[2], (b, f, h, w, out_dim))

    def both(x, kernel, dy):
        y, pull_back = jax.vjp(form, x, kernel)
        return y, pull_back(dy)

    return milliseconds(jax.jit(form), x, kernel), milliseconds(jax.jit(both), x, kernel, dy)


def main():
    """Print a row for each shape: milliseconds forward / with gradients, by form."""
    table = Table("b f h w in -> out", *(form.__name__ for form in FORMS))
    for shape, out_dim in SHAPES:
        cells = ("{:.0f} / {:.0f}".format(*measure(form, shape, out_dim)) for form in FORMS)
        table.add_row(f"{' '.join(map(str, shape))} -> {out_dim}", *cells)
    console = Console()
    console.print(table)
    console.print(f"ms forward / with gradients, on {jax.devices()[0].device_kind}")


if __name__ == "__main__":
    main()
