"""Backlash inverse, equations (2.2) and (2.3), with a direction band and a slow take-up."""

from math import inf

from backlash_ros.core.backlash import Region
from backlash_ros.core.errors import ParameterError

LEFT, GAP, RIGHT = Region.LEFT, Region.GAP, Region.RIGHT


class BacklashInverse:
    """v = BI(u_d): crosses the gap whenever u_d turns, equations (2.2) and (2.3).

    With the true m, c_r, c_l this is the exact inverse (2.2); with estimates, which may differ
    from call to call, the adaptive inverse (2.3).

    direction_band: u_d has turned only when it came back from its extreme by more than this
        [unit of u_d]; until then v is held. 0 is the printed inverse.
    take_up: largest move of v per sample while the gap is crossed [unit of v] (2.3: "a line
        segment with a finite slope"); inf jumps.
    """

    def __init__(self, direction_band: float = 0.0, take_up: float = inf) -> None:
        if not direction_band >= 0.0:
            raise ParameterError('inverse.direction_band', direction_band, 'must be >= 0')
        if not take_up > 0.0:
            raise ParameterError('inverse.take_up_rate', take_up, 'must be > 0')
        self.direction_band, self.take_up = direction_band, take_up
        self._least_band = direction_band
        self.limited = False  # whether the last v could not be applied as it was
        self.v = 0.0
        self.side = GAP  # line in use; GAP until u_d moves for the first time
        self.extreme = 0.0  # furthest u_d in the present direction: u_d(t-1) when the band is 0
        self.taking_up = False  # whether v is still on its way to the line

    def set_band(self, band: float) -> None:
        """Use this band, and none narrower from now on."""
        self.direction_band = self._least_band = band

    def widen_band(self, band: float) -> None:
        """Use this band while it is wider than the one set: the noise of u_d may vary."""
        self.direction_band = max(self._least_band, band)

    def direction(self, u_d: float) -> Region:
        """Line on which u_d lies: RIGHT going up, LEFT going down, GAP where v is held.

        Asking does not advance the state.
        """
        move, band = u_d - self.extreme, self.direction_band
        # Only a turn has to leave the band; going on in the same direction is never noise.
        if move > 0.0:
            return RIGHT if band == 0.0 or self.side == RIGHT or move > band else GAP
        if move < 0.0:
            return LEFT if band == 0.0 or self.side == LEFT or move < -band else GAP
        return GAP

    def step(self, u_d: float, m: float, c_r: float, c_l: float) -> float:
        """Return v(t) for u_d(t) and the parameters in use, equation (2.3)."""
        side = self.direction(u_d)
        if side != GAP:
            self.taking_up = self.taking_up or side != self.side
            self.side, self.extreme = side, u_d
        elif not self.taking_up:
            return self.v
        target = self.extreme / m + (c_r if self.side == RIGHT else c_l)
        move = target - self.v
        if self.taking_up and abs(move) > self.take_up:
            self.v += self.take_up if move > 0.0 else -self.take_up
        else:
            self.v, self.taking_up = target, False
        return self.v

    def aim(self, u_d: float, side: Region) -> None:
        """Let the next step go to u_d on the line of this side, whatever it came from."""
        self.side, self.extreme, self.taking_up = side, u_d, True

    def hold(self, u_d: float) -> float:
        """Keep v although u_d moved to where no line fits, and return v."""
        if self.direction_band == 0.0:
            self.extreme = u_d
        return self.v

    def start_from(self, v: float) -> None:
        """Say which v acts before the first step."""
        self.v = v

    def applied(self, v: float) -> None:
        """Say which v was really applied (limits), so that the next move starts from there."""
        self.limited = v != self.v
        # A v that was held back goes on its way although u_d rests.
        self.taking_up = self.taking_up or self.limited
        self.v = v
