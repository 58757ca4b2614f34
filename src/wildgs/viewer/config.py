"""Configuration of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

LOCAL = "127.0.0.1"


@dataclass(frozen=True)
class ServerConfig:
    """Where the viewer is reached.

    Attributes:
        host: Address to listen on: 127.0.0.1 for local access only, 0.0.0.0 for all interfaces. Whoever has the
            address with its token sees the photos and can use this machine's processor.
        port: Port to listen on; the next free one where it is taken.
        share: Also open a public address through viser's relay.
    """

    host: str = LOCAL
    port: int = 8080
    share: bool = False


@dataclass(frozen=True)
class ViewerConfig:
    """Contents of the viewer's page.

    Attributes:
        photos: Number of photos shown as thumbnails and frustums; all others can be chosen by name.
    """

    photos: int = 48
