"""A recogniser of a level's options: logistic regression on windows of observations and controls."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, pad

from ddco_pyro.model.batch import Batch
from ddco_pyro.model.networks import Inputs, InputShape
from ddco_pyro.model.networks.conv import POOLED

SCALES = 2
"""Windows of a step, beside the step alone."""

FLOOR = -12.0
"""The least log r of an option that has labelled steps: no window makes an option impossible."""

FRAMES_AT_ONCE = 64
"""Pictures that are converted to floating-point numbers together."""


class Windows(nn.Module):
    """Multinomial logistic regression r(h | window) of the option of a step.

    The features of step t are x_t and the means of x over the steps t - w to t + w, for two widths w. x_t is
    the encoded observation, the block means of pictures, and the scaled control. A regression on the past has
    the control before the step, 0 at the first one, and means over the steps t - w to t.

    :param options: k, the options of the level.
    :param shape: of the observations.
    :param controls: A', the control dimensions in the model.
    :param past: whether the features are of the past alone.
    :param pictures: further inputs behind the controls, which have one unit.
    :ivar alike: the features that have one unit, and are not standardised one by one, bool [3 F].
    :ivar share: the share of labelled steps of each option, [k]; 0 for an option without any.
    """

    weight: Tensor
    bias: Tensor
    share: Tensor
    widths: Tensor

    def __init__(self, options: int, shape: InputShape, controls: int, past: bool, pictures: int = 0) -> None:
        super().__init__()
        self.past = past
        size = (
            shape.vector + sum(image[-1] * POOLED**2 for image in shape.images.values()) + controls + pictures
        )
        self.alike = torch.arange(size).ge(size - pictures).repeat(1 + SCALES)
        for name, shaped in (
            ("weight", ((1 + SCALES) * size, options)),
            ("bias", (options,)),
            ("share", (options,)),
        ):
            self.register_buffer(name, torch.zeros(shaped, dtype=torch.float64))
        self.register_buffer("widths", torch.ones(SCALES, dtype=torch.int64))

    def features(self, inputs: Inputs, actions: Tensor, lengths: Tensor) -> Tensor:
        """The features of every step, [N, T, 3 F] float64; arbitrary past a trajectory's end.

        :param actions: scaled controls, [N, T, A'].
        :param lengths: steps of each trajectory, [N].
        """
        if self.past:
            actions = pad(actions[:, :-1], (0, 0, 1, 0))
        x = torch.cat([observed(inputs), actions.double()], dim=-1)
        widths = self.widths.tolist()
        return torch.cat(
            [x, *(window_means(x, lengths, width, 0 if self.past else width) for width in widths)], dim=-1
        )

    def latest(self, rows: Sequence[Tensor]) -> Tensor:
        """The features [3 F] of the last of consecutive steps from x of each [F]: those of the past."""
        return torch.cat(
            [rows[-1], *(torch.stack([*rows[-1 - width :]]).mean(0) for width in self.widths.tolist())]
        )

    def log_probability(self, features: Tensor) -> Tensor:
        """log r(h | window), [..., k]; -inf for an option without labelled steps."""
        logits = features @ self.weight + self.bias
        return torch.where(self.share > 0, logits, -torch.inf).log_softmax(-1)

    def log_ratio(self, features: Tensor) -> Tensor:
        """log r(h | window) - log p(h) of each choice, [..., 1 + k], p being the share of labelled steps.

        log r is at least :data:`FLOOR`. Of control and of options without labelled steps the windows say
        nothing: 0.
        """
        ratio = self.log_probability(features).clamp(min=FLOOR) - self.share.log()
        return pad(torch.where(self.share > 0, ratio, 0.0), (1, 0))


def window_means(x: Tensor, lengths: Tensor, before: int, after: int) -> Tensor:
    """The mean of each step and of so many steps before and after it, fewer at the ends, [N, T, F].

    :param x: [N, T, F].
    :param lengths: steps of each trajectory, [N]; means of steps past them are arbitrary.
    """
    sums, time = pad(x.cumsum(1), (0, 0, 1, 0)), torch.arange(x.shape[1])
    first = (time - before).clamp(min=0).expand(len(x), -1)
    last = torch.minimum(time + after + 1, lengths[:, None]).maximum(first + 1)
    low, high = (sums.gather(1, end.unsqueeze(-1).expand(*end.shape, x.shape[-1])) for end in (first, last))
    return (high - low) / (last - first).unsqueeze(-1)


class Recogniser(nn.Module):
    """What windows say of the options of a level, as evidence γ (log r(h | window) - log p(h)) of each
    choice.

    :param level: 1 is the lowest.
    :ivar around: sees the steps before and after a step.
    :ivar past: sees the past alone, for an agent that is watched while it acts.
    :ivar gamma: γ.
    """

    gamma: Tensor

    def __init__(self, level: int, options: int, shape: InputShape, controls: int) -> None:
        super().__init__()
        self.level = level
        self.around = Windows(options, shape, controls, past=False)
        self.past = Windows(options, shape, controls, past=True)
        self.register_buffer("gamma", torch.zeros((), dtype=torch.float64))

    def evidence(self, batch: Batch) -> Tensor:
        """The evidence of each choice at every step, [N, T, 1 + k]."""
        return self.gamma * self.around.log_ratio(
            self.around.features(batch.inputs, batch.actions, batch.lengths)
        )

    def options(self, batch: Batch) -> Tensor:
        """The likeliest option of every step by itself, 1 to k, [N, T]; arbitrary past a trajectory's end."""
        features = self.around.features(batch.inputs, batch.actions, batch.lengths)
        return self.around.log_probability(features).argmax(-1) + 1


def observed(inputs: Inputs) -> Tensor:
    """All vectors, and the block means of all pictures, [N, T, F] float64."""
    parts = inputs.chunks(FRAMES_AT_ONCE // inputs.batch[0]) if inputs.images else [inputs]
    each = []
    for part in (part.loaded() for part in parts):
        frames = (image.flatten(0, 1).permute(0, 3, 1, 2).float() / 255 for image in part.images.values())
        means = (adaptive_avg_pool2d(image, POOLED).flatten(1).unflatten(0, part.batch) for image in frames)
        each.append(torch.cat([part.vector, *means], dim=-1).double())
    return torch.cat(each, dim=1)
