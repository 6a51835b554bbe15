"""What each stage of a model makes, in the order in which they follow; light enough for a parser."""

from __future__ import annotations

STAGES = {
    "command": "what becomes of the command before it reaches the motors: a fixed chain of delay, "
    "saturation and curve",
    "rotor": "from command to rotor speed: factors multiply, then at most one lag",
    "thrust": "from rotor speed to thrust: factors multiply, then increments add",
    "body": "mass, inertia and centre of mass: one value each, changed by increments",
    "wrench": "further forces and moments on the body: they add",
    "sensor": "what the sensors report: a fixed chain of lever arm, misalignment, scale, bias and "
    "delay",
}
