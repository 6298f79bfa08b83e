"""Runs a student's code in a process that can do no harm.

:mod:`~robotbrain.grading.sandbox.forkserver` keeps a warm Python process inside :mod:`bubblewrap
<robotbrain.grading.sandbox.bubblewrap>` and forks one child of it per submission;
:mod:`~robotbrain.grading.sandbox.child` shuts that child in and runs its cells;
:mod:`~robotbrain.grading.sandbox.process` is the grader's handle on it. What a host cannot give is named by
:mod:`~robotbrain.grading.sandbox.layers`.
"""
