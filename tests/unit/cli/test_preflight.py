"""`egosim preflight` of generation with weights and activations in 8 bits."""

import json

from egosim_jax.cli.__main__ import main
from egosim_jax.runtime.command import ExitCode


def preflight(capsys, *options):
    assert main(["preflight", "--config", "debug", "--target", "cpu:1", "--json", *options]) == 0
    return json.loads(capsys.readouterr().out)


def test_weights_in_8_bits_take_less_memory(capsys):
    """The arguments of each program include the weights of all networks."""
    whole = preflight(capsys)
    narrow = preflight(capsys, "--weights-8bit", "float8")
    both = preflight(capsys, "--weights-8bit", "int8", "--activations-8bit")
    for name, report in whole.items():
        arguments = report["memory"]["arguments"]
        assert narrow[name]["memory"]["arguments"] < 0.9 * arguments
        assert both[name]["memory"]["arguments"] < 0.9 * arguments
        assert narrow[name]["hardware_flops"] == both[name]["hardware_flops"]
        assert narrow[name]["hardware_flops"] == report["hardware_flops"]


def test_activations_in_8_bits_need_weights_in_8_bits(capsys):
    command = ["preflight", "--config", "debug", "--target", "cpu:1", "--activations-8bit"]
    assert main(command) == ExitCode.USAGE
    assert "(--weights-8bit)" in " ".join(capsys.readouterr().err.split())
