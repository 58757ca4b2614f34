"""Configuration of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

LOCAL = "127.0.0.1"


@dataclass(frozen=True)
class ServerConfig:
    """Network address of the viewer.

    Attributes:
        host: Address to listen on: 127.0.0.1 for local access only, 0.0.0.0 for all interfaces. Anyone with the
            URL and its token can see the photos and use this machine's processor.
        port: Port to listen on; if it is taken, the next free one.
        share: Also create a public URL through viser's relay server.
    """

    host: str = LOCAL
    port: int = 8080
    share: bool = False


@dataclass(frozen=True)
class ViewerConfig:
    """Content of the viewer's page.

    Attributes:
        photos: Number of photos shown as thumbnails and frustums; the others can be selected by name.
    """

    photos: int = 48
