"""Real-time patterns: how to arrange a brain's stages, keep a rate, judge old data, and hold a deadline.

- :mod:`~robotbrain.pipeline.patterns.stages`: what each stage costs on a Jetson.
- :mod:`~robotbrain.pipeline.patterns.brains`: the same stages as sequential, pipelined and parallel brains.
- :mod:`~robotbrain.pipeline.patterns.forms`: what these brains must do, in closed form.
- :mod:`~robotbrain.pipeline.patterns.rates`, :mod:`~robotbrain.pipeline.patterns.jitter`: loops that keep a rate, in
  exact time and on this machine.
- :mod:`~robotbrain.pipeline.patterns.ages`: stale data (messages are paired by :mod:`robotbrain.ros.message_filters`).
- :mod:`~robotbrain.pipeline.patterns.budgets`, :mod:`~robotbrain.pipeline.patterns.chains`: deadlines and bounds.
- :mod:`~robotbrain.pipeline.patterns.queues`: what to do with more data than can be worked off.
- :mod:`~robotbrain.pipeline.patterns.plots`: figures of all these (needs matplotlib).
"""

from __future__ import annotations
