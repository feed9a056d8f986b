"""Settings of the middleware: the shipped ones for Fast DDS, unless the user has made some."""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

#: What a user sets who wants other transports or profiles.
_OF_USER = (
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
)
_FAST_DDS = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")


def use_shipped_profile(environment: MutableMapping[str, str], *, profile: Path, middleware: str) -> str:
    """Have Fast DDS use ``profile`` where the user has set nothing, and return which settings are used.

    Its own shared memory of 512 KB is filled by one image of 512 x 424 pixels, and the messages beside it
    come seconds late. ``middleware``: the name of the one in use. To be called before nodes are made.
    """
    if middleware not in _FAST_DDS:
        return f"middleware: {middleware}, with its own settings"
    for name in _OF_USER:
        if environment.get(name):
            return f"middleware: Fast DDS as {name}={environment[name]} says"
    if not profile.is_file():
        return "middleware: Fast DDS with its own settings"
    environment[_OF_USER[1]] = str(profile)
    return f"middleware: Fast DDS with {profile}"
