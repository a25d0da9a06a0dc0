"""XLA's flags in the tests, where compiling takes longer than running."""

from importlib.metadata import version

QUICK = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
"""The same operations, whose machine code is not optimized."""
if version("jaxlib").startswith("0.10."):
    # Later versions have no other emitters, and end at a flag that they do not know.
    QUICK += " --xla_cpu_use_fusion_emitters=false"


def devices(count: int) -> dict[str, str]:
    """The environment of a program that sees so many CPU devices."""
    flags = f"{QUICK} --xla_force_host_platform_device_count={count}"
    return {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
