"""Labels by hand: a model proposes segments, a person corrects them, and the posterior follows at once."""
