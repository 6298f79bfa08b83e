"""Stand-ins for NVIDIA Jetson modules: what the brain's work would take there.

For now a profile holds fixed latencies, each labelled with its provenance.
"""

from robotbrain.jetson.engine import OnnxEngine
from robotbrain.jetson.profiles import JetsonProfile, list_profiles, load_profile

__all__ = ["JetsonProfile", "OnnxEngine", "list_profiles", "load_profile"]
