"""The networks that a config can name: a new one is a module in this folder and a line in ``TRUNKS``."""

from lanenet.learn.trunks.alexnet import AlexNetTrunk
from lanenet.learn.trunks.compact import BaseTrunk, NanoTrunk, SmallTrunk, Trunk

#: By the name in ``learn.network.kind``.
TRUNKS: dict[str, type[Trunk]] = {
    "nano": NanoTrunk,
    "small": SmallTrunk,
    "base": BaseTrunk,
    "alexnet": AlexNetTrunk,
}
