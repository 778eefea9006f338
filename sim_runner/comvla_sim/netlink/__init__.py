"""A real link on one Linux machine: two network namespaces, a shaped cable between them, real TCP.

The robot's namespace and the cloud's are joined by a pair of virtual Ethernet devices. What leaves
the robot passes a token bucket whose rate a channel changes every control period; what is late is
late, as on a radio. Needs root, because only root may make network devices.
"""
