"""Configuration of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

LOCAL = "127.0.0.1"


@dataclass(frozen=True)
class ServerConfig:
    """Where the viewer is reached.

    Attributes:
        host: Address to listen on. The default lets this machine in and no other; 0.0.0.0 lets everyone in who can
            reach this machine, who then sees the photos and can use its processor.
        port: Port to listen on; the next free one where it is taken.
        share: Also make a public address through viser's own relay: everyone who has it can look.
    """

    host: str = LOCAL
    port: int = 8080
    share: bool = False


@dataclass(frozen=True)
class ViewerConfig:
    """What is shown.

    Attributes:
        photos: How many photos are offered as thumbnails and frustums; more are reached by name.
    """

    photos: int = 48
