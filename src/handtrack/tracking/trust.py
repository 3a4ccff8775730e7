"""Over frames: whether what is tracked is a hand, from the judge's log-odds in single frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from handtrack.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class TrustConfig:
    """When a track is believed, and when no more."""

    start_chance: float = 0.75
    """Chance of being a hand from which a new track is believed."""
    alone_chance: float = 0.5
    """The same for a frame that stands alone, where waiting for the next one is no choice."""
    drop_chance: float = 0.2
    """Chance below which a track is given up."""
    refuse_chance: float = 0.2
    """Chance below which a place that was found anew is taken for something else."""
    doubt_chance: float = 0.5
    """Chance in one frame below which its pose is doubted."""
    period: int = 3
    """Frames between judgements of a believed track that nothing speaks against."""
    memory: float = 4.0
    """Judgements that are averaged."""
    firm: float = 4.0
    """Log-odds of one frame count up to this, so that no frame decides for long."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for name in (
            "start_chance", "alone_chance", "drop_chance", "refuse_chance", "doubt_chance"
        ):  # fmt: skip
            if not 0 < getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; expected between 0 and 1")
        if max(self.drop_chance, self.refuse_chance) >= self.start_chance:
            raise InputError(
                f"drop_chance {self.drop_chance} and refuse_chance {self.refuse_chance} are not "
                f"below start_chance {self.start_chance}"
            )
        if self.period < 1 or self.memory < 1 or self.firm <= 0:
            raise InputError(
                f"period, memory, firm are {self.period}, {self.memory}, {self.firm}; expected at "
                "least 1, 1 and above 0"
            )


def odds_of(chance: float) -> float:
    """Log-odds of a chance."""
    return math.log(chance / (1.0 - chance))


class Trust:
    """Running log-odds of one track."""

    def __init__(self, config: TrustConfig) -> None:
        """Start without a track."""
        self._config = config
        self.forget(known=False)

    def forget(self, *, known: bool) -> None:
        """Start anew; a pose that somebody vouches for is a hand until much speaks against it."""
        self._since = self._config.period
        self.odds = self._config.firm if known else 0.0
        """Running log-odds that the track is a hand."""
        self._weight = self._config.memory if known else 0.0
        self._last = self.odds

    @property
    def due(self) -> bool:
        """Whether a believed track is to be judged in this frame; once per frame."""
        self._since += 1
        return self._since >= self._config.period or self.doubtful

    @property
    def doubtful(self) -> bool:
        """Whether the last judgement spoke against the pose."""
        return self._last < odds_of(self._config.doubt_chance)

    @property
    def refuses(self) -> bool:
        """Whether a track that was not believed yet is no hand."""
        return self._weight > 0 and self.odds < odds_of(self._config.refuse_chance)

    def hear(self, odds: float) -> None:
        """Take a judgement in."""
        firm = self._config.firm
        self._last = float(np.clip(odds, -firm, firm))
        self._weight = min(self._weight + 1.0, self._config.memory)
        self.odds += (self._last - self.odds) / self._weight
        self._since = 0

    def believes(self, *, sure: bool) -> bool:
        """Whether the track counts as a hand: a new one, or one that was believed so far."""
        config = self._config
        return self.odds >= odds_of(config.drop_chance if sure else config.start_chance)

    def convinced(self, odds: float) -> bool:
        """Whether one look is enough to believe a new track."""
        return odds >= odds_of(self._config.start_chance)

    def believes_alone(self, odds: float) -> bool:
        """Whether a pose in a frame without others counts as a hand."""
        return odds >= odds_of(self._config.alone_chance)
