"""A replica has the same bits on one device and on a share of several."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).with_name("devices.py")


@pytest.mark.parametrize(
    "words", [[], pytest.param(["lockstep"], marks=pytest.mark.environment)], ids=str
)
def test_results_on_four_devices_are_those_on_one_to_the_bit(words: list[str]) -> None:
    """Of processors that are emulated; in lockstep as on accelerators."""
    # The sums of the older emitter depend on what else is in an array; users have the newer one.
    flags = os.environ["XLA_FLAGS"].replace("fusion_emitters=false", "fusion_emitters=true")
    environment = os.environ | {"XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=4"}
    command = [sys.executable, str(PROGRAM), *words]
    process = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
