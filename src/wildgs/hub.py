"""Whether the Hugging Face hub can be asked at all: its client retries for half a minute where it cannot."""

from __future__ import annotations

import os
import threading
import urllib.error
import urllib.request

TIMEOUT = 4.0


def hub_reachable(timeout: float = TIMEOUT) -> bool:
    """Whether the hub answers within `timeout` seconds; False where HF_HUB_OFFLINE forbids asking."""
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE or os.environ.get("HF_HUB_OFFLINE", "0").lower() in (
        "1",
        "true",
        "yes",
        "on",
    ):
        return False
    answered = threading.Event()

    def ask() -> None:
        try:
            urllib.request.urlopen(urllib.request.Request(constants.ENDPOINT, method="HEAD"), timeout=timeout)
        except urllib.error.HTTPError:
            answered.set()  # an answer, if not a kind one
        except (OSError, ValueError):
            return
        answered.set()

    # Looking up a name has no timeout of its own, hence the thread.
    threading.Thread(target=ask, daemon=True).start()
    return answered.wait(timeout)
