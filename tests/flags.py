"""XLA's flags in the tests, where compiling takes longer than what is compiled."""

QUICK = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
"""The same operations, whose machine code is not optimized."""


def devices(count: int) -> dict[str, str]:
    """The environment of a program that sees so many CPU devices."""
    flags = f"{QUICK} --xla_force_host_platform_device_count={count}"
    return {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
