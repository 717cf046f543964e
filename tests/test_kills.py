"""Commands that are killed and interrupted at random moments lose nothing."""

import kills
import pytest


@pytest.mark.slow
@pytest.mark.parametrize("command", ["generate", "evaluate", "train"])
def test_nothing_is_lost(command):
    for result in kills.main(["--moments", "4", "--command", command, "--seed", "1"]):
        assert result["strikes"] == 4
        assert (result["lost"], result["written_again"]) == (0, 0)
        assert result["slowest_end_s"] < 20
