"""Tasks in simulation: their interface, episodes, collection of demonstrations, videos, Gymnasium."""
