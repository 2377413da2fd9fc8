"""What can go wrong beside an arm, and be rehearsed on the simulated one. Imports no simulator."""

from collections.abc import Mapping

FAULTS: Mapping[str, str] = {
    "cable": "the bus is gone until the arm is connected again",
    "power": "the arm is off until it is connected again",
    "camera": "every camera gives the same image until the end of the episode",
    "key": "the operator lets go of the dead man's key",
    "away": "the operator does not answer",
}
