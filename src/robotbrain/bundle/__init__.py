"""``robotbrain bundle``: the course as a zip for students, without what is for instructors.

:mod:`.contents` says which files go in, :mod:`.key` looks for the key in all of them, :mod:`.archive` writes the same
bytes wherever it is run, :mod:`.commands` is the command. What the key is, and what of the course's own solutions
students may read, is written down in ``autograder/PROTECTION.md``.
"""

from __future__ import annotations
