"""Which precision networks run in."""

from __future__ import annotations

import pytest
import torch

from wildgs.model.precision import choose_precision

CUDA = torch.device("cuda")


@pytest.mark.parametrize(("fast", "wanted"), [(True, torch.bfloat16), (False, torch.float32)])
def test_emulated_bfloat16_is_not_taken(monkeypatch: pytest.MonkeyPatch, fast: bool, wanted: torch.dtype):
    """Turing and Volta emulate it, which torch counts as support."""
    monkeypatch.setattr(
        torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation or fast
    )
    assert choose_precision("auto", CUDA) == wanted
    assert choose_precision("bfloat16", CUDA) == torch.bfloat16
    assert choose_precision("float32", CUDA) == torch.float32
