"""Checks whether the Hugging Face hub is reachable; its own client retries for half a minute if it is not."""

from __future__ import annotations

import os
import threading
import urllib.error
import urllib.request

TIMEOUT = 4.0


def hub_reachable(timeout: float = TIMEOUT) -> bool:
    """Whether the hub answers within `timeout` seconds; False if HF_HUB_OFFLINE is set."""
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
            answered.set()  # an HTTP error is an answer too
        except (OSError, ValueError):
            return
        answered.set()

    # In a thread, because the DNS lookup has no timeout.
    threading.Thread(target=ask, daemon=True).start()
    return answered.wait(timeout)
