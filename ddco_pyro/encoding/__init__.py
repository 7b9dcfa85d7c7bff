"""Encoders of pictures: features in place of a picture observation, in a file and when a policy acts."""

from ddco_pyro.encoding.encoder import Encoder, load
from ddco_pyro.encoding.writing import Encoded, Encoding, encode

__all__ = ["Encoded", "Encoder", "Encoding", "encode", "load"]
