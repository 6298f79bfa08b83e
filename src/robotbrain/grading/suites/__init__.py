"""The visible tests of each lab, shared by instant checks, nbgrader and CI."""
