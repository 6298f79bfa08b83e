"""The trusted process that tests one submission, whose code runs in another process."""
