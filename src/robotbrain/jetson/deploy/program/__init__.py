"""The program of a bundle that runs on the board: Python 3.6 or later, and what JetPack has.

It is copied into each bundle as it is, and imports nothing of the kit. Newer Python than 3.6 is out of bounds here.
"""
