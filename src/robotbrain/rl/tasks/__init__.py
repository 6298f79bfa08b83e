"""The tasks: one module each, with its configuration and the recipe of its policy."""
