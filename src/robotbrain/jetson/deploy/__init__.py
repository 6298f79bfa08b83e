"""Bundles: a network with all that a Jetson needs to build, check and time it, and that anyone can verify offline.

A bundle is made on any machine (:func:`make_bundle`), copied to the board, and run there with nothing but JetPack
(``sh run.sh``). The board writes a result, which ``robotbrain jetson measure --from-bundle`` turns into a measured
profile. Names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy

if TYPE_CHECKING:
    from robotbrain.jetson.deploy.bundle import make_bundle
    from robotbrain.jetson.deploy.network import Preprocessing
    from robotbrain.jetson.deploy.results import profile_from_result
    from robotbrain.jetson.deploy.verify import Report, verify_bundle

__all__ = ["Preprocessing", "Report", "make_bundle", "profile_from_result", "verify_bundle"]

_MODULE_OF = {
    "Preprocessing": "network",
    "Report": "verify",
    "make_bundle": "bundle",
    "profile_from_result": "results",
    "verify_bundle": "verify",
}

__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())
