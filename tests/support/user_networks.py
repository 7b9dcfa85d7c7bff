"""Networks as a user might write them, right and wrong; a spec names them as ``user_networks:Own``."""

import torch
from torch import nn


class Own(nn.Module):
    """A network as a user might write it."""

    def __init__(self, shape, outputs, copies, gain=1.0):
        super().__init__()
        if gain <= 0:
            raise ValueError("the gain has to be positive")
        self.size, self.gain = (copies, outputs), nn.Parameter(torch.tensor(gain))

    def forward(self, inputs):
        return (self.gain * inputs.vector.sum(-1))[..., None, None].expand(*inputs.batch, *self.size)


class Narrow(Own):
    """The same with its own number of outputs where another network reads it."""

    features = 5


class Diverging(Own):
    """Linear; where its first weight begins positive, NaN after so many training passes, which it counts."""

    def __init__(self, shape, outputs, copies, passes):
        super().__init__(shape, outputs, copies)
        self.weight = nn.Parameter(0.1 * torch.randn(shape.vector, copies * outputs))
        self.register_buffer("left", torch.where(self.weight[0, 0] > 0, passes, 10**6))

    def forward(self, inputs):
        if self.training:
            self.left -= 1
        found = (inputs.vector @ self.weight).unflatten(-1, self.size)
        return torch.where(self.left < 0, torch.nan, found)


class Wrong(Own):
    """A network of one's own that can be made, but whose output is not what it has to be."""

    def __init__(self, shape, outputs, copies, how):
        super().__init__(shape, outputs, copies)
        self.how = how

    def forward(self, inputs):
        found = super().forward(inputs)
        if self.how == "list":
            return found.tolist()
        return {
            "swapped": lambda: found.transpose(2, 3),
            "squeezed": lambda: found.squeeze(0),
            "time first": lambda: found.transpose(0, 1),
            "fails": lambda: found @ torch.ones(7),
        }[self.how]()


class Remembering(nn.Module):
    """A network of one's own with a state: the sum of what it has seen, and how many steps that were."""

    def __init__(self, shape, outputs, copies, how="right"):
        super().__init__()
        self.how, self.size = how, (copies, outputs)
        self.head = nn.Linear(shape.vector, copies * outputs)

    def initial_state(self, trajectories):
        features = self.head.in_features
        state = torch.zeros(trajectories, features), torch.zeros(trajectories)
        states = {"list": list(state), "without trajectories": (torch.zeros(features), state[1])}
        return states.get(self.how, state)

    def forward(self, inputs, state):
        total, steps = state
        sums = total[:, None] + inputs.vector.cumsum(1)
        counts = steps[:, None] + torch.arange(1, inputs.batch[1] + 1)
        outputs = self.head(sums / counts[..., None]).unflatten(-1, self.size)
        after = sums[:, -1], counts[:, -1]
        return {
            "alone": lambda: outputs,
            "other shape": lambda: (outputs, (sums, counts)),
            "forgets": lambda: (outputs, (total, counts[:, -1])),
            "looks ahead": lambda: (outputs + sums[:, -1:, None, :1], after),
            "over trajectories": lambda: (outputs + sums.mean((0, 2), keepdim=True)[..., None], after),
        }.get(self.how, lambda: (outputs, after))()


class NotANetwork:
    pass


class WithMemory(nn.Module):
    """A network of one's own whose output at a step is not that of the step alone."""

    def __init__(self, shape, outputs, copies, how):
        super().__init__()
        self.how, self.size = how, (copies, outputs)
        self.lstm = nn.LSTM(shape.vector, 16, batch_first=how != "over trajectories")
        features = 16 if how in ("over time", "over trajectories") else shape.vector
        self.head = nn.Linear(features, copies * outputs)

    def forward(self, inputs):
        features = {
            "over time": lambda x: self.lstm(x)[0],
            "over trajectories": lambda x: self.lstm(x)[0],
            "differences": lambda x: torch.cat([x[:, :1], x[:, 1:] - x[:, :-1]], 1),
            "later steps": lambda x: x.flip(1).cumsum(1).flip(1),
            "whole trajectory": lambda x: x - x.mean(1, keepdim=True),
            "whole batch": lambda x: x / (1 + x.square().sum()),
            "chance": lambda x: nn.functional.dropout(x, 0.5, training=True),
        }[self.how](inputs.vector)
        return self.head(features).unflatten(-1, self.size)


class WithMemoryAndZeros(WithMemory):
    """The same whose outputs are 0 at first."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        for parameter in self.head.parameters():
            nn.init.zeros_(parameter)
