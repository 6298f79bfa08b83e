"""The way to genuine Isaac Lab: outdated names (:mod:`.names`) and the exporter (:mod:`.export`)."""
