"""Robots anywhere on a secure fleet network, as one `Fleet`.

`driver`: what a robot can do. `robot`: the process on the robot's machine. `fleet`: all robots, for the loop.
`wire`: what the two say to each other. `setup`: keys and policy of a fleet.
"""
