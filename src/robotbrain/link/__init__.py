"""Brain and robot as processes of their own.

- :mod:`~robotbrain.link.realtime`: the kit's nodes in wall-clock time;
- :mod:`~robotbrain.link.local`: brain and robot over loopback TCP, on any laptop;
- :mod:`~robotbrain.link.lockstep`: the same, in simulated time, one window after the other;
- :mod:`~robotbrain.link.genuine`: the nodes on genuine rclpy;
- :mod:`~robotbrain.link.dds`: the kit's nodes on a DDS network with genuine ROS 2 programs (an optional extra);
- :mod:`~robotbrain.link.robot`: the simulated robot as a process.

Nothing is ever pickled: frames carry CDR, and JSON where they describe the graph.
"""
