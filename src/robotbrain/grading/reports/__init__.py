"""What comes out of grading for people: feedback pages, the class table, item analysis, similarity, exports.

Everything starts from ``results.json`` (:mod:`.model`) and the executed notebooks. What a student wrote reaches a page
only through :mod:`.page`, which escapes and bounds it.
"""
