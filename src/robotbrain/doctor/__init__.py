"""``robotbrain doctor``: what is wrong with an installation, and the exact step that mends it.

Each of the :mod:`~robotbrain.doctor.probes` looks at one thing and returns :class:`~robotbrain.doctor.finding.Finding`
objects. A doctor is called when things are broken, so it leans on as little as it can: only the standard library is
imported at the top of its modules, whatever may take the interpreter down (native libraries) is tried in a process of
its own, and a probe that raises or hangs becomes a finding itself (:mod:`~robotbrain.doctor.running`).
"""
