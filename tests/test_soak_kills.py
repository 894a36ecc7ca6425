"""Row 4 in short, and that its checkers see what is broken."""

from __future__ import annotations

import pytest
from soak.proof import prove


@pytest.mark.alone
def test_sigkill_at_any_instant_costs_at_most_a_tenth_of_a_second(tmp_path):
    prove(4, tmp_path)
