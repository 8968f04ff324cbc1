"""Backlash inverse, equations (2.2) and (2.3), with a direction band and a slow take-up."""

from math import inf, nan

from backlash_ros.core.plant.backlash import GAP, LEFT, RIGHT, Region, clamp


class BacklashInverse:
    """v = BI(u_d): crosses the gap whenever u_d turns; exact (2.2) with the true m, c_r, c_l.

    direction_band: u_d has turned only when it came back from its extreme by more than this;
    0 is the printed inverse. take_up: largest move of v per sample while the gap is crossed (2.3:
    "a line segment with a finite slope"), and over to a line that new estimates have moved.
    """

    def __init__(self, direction_band: float = 0.0, take_up: float = inf) -> None:
        self.direction_band, self.take_up = direction_band, take_up
        # Line in use, GAP until u_d moves for the first time, and furthest u_d on it.
        self.v, self.side, self.extreme = 0.0, GAP, 0.0
        self.taking_up = False  # whether v is still on its way to the line
        self._slowed = False  # whether it is until it is where u_d wants it
        self.limited = False  # whether the last v could not be applied as it was
        self._play = nan, nan, nan  # m, c_r, c_l in use the sample before
        self._u = 0.0  # what they make of v, as long as v is on its way to a line

    def direction(self, u_d: float, band: float) -> Region:
        """Line on which u_d lies: RIGHT going up, LEFT going down, GAP where v is held."""
        move = u_d - self.extreme
        side = RIGHT if move > 0.0 else LEFT if move < 0.0 else GAP
        # Only a turn has to leave the band; going on in the same direction is never noise.
        return side if band == 0.0 or side is self.side or abs(move) > band else GAP

    def step(
        self, u_d: float, m: float, c_r: float, c_l: float, band: float | None = None,
    ) -> float:
        """Return v(t) for u_d(t) and the parameters in use (2.3); band: not direction_band."""
        band = self.direction_band if band is None else band
        side = self.direction(u_d, band)
        if self.taking_up and self.side is not GAP:
            # u is held until v arrives: it turns only where u_d lies on the other side of that.
            self._note_on_the_way()
            side = Region(-self.side) if (self._u - u_d) * self.side > band else self.side
        elif self.side is GAP and side is not GAP:
            self.side, self._u, self.taking_up = side, self.extreme, True
        return self.follow(side, u_d, m, c_r, c_l)

    def follow(self, side: Region, u_d: float, m: float, c_r: float, c_l: float) -> float:
        """Return v for u_d on the line of a side, on which it only goes on; else u is held."""
        if side is GAP:
            return self.v
        if self.side is GAP:
            self._u = u_d  # nobody knows what u is
        elif self.taking_up:
            self._note_on_the_way()
        else:
            self._u = self.extreme
        if side is not self.side:
            self.side, self.taking_up = side, True
        elif not self.taking_up and (u_d - self.extreme) * side <= 0.0:
            return self.v
        self.extreme = u_d if (u_d - self._u) * side > 0.0 else self._u
        self.taking_up = True
        return self.proceed(m, c_r, c_l)

    def aim(self, u_d: float, side: Region) -> None:
        """Let the next step go to u_d on the line of this side, whatever it came from."""
        self._u = self.held_u
        self.side, self.extreme, self.taking_up = side, u_d, True

    def proceed(self, m: float, c_r: float, c_l: float) -> float:
        """Return v, on its way to the line no faster than the gap is crossed until it moves u."""
        if not self.taking_up:
            return self.v
        crossing = c_r if self.side is RIGHT else c_l
        # Where v begins to move u, or would have stood if these parameters had been in use before.
        way = (self.extreme if self._slowed else self._u) / m + crossing - self.v
        if abs(way) > self.take_up:
            self.v += self.take_up if way > 0.0 else -self.take_up
        else:
            self.v = self.extreme / m + crossing
            self.taking_up = self._slowed = False
        self._play = m, c_r, c_l
        return self.v

    def slow_down(self) -> None:
        """Let v go on to where u_d wants it like it crosses the gap, until it is there."""
        self.taking_up = self._slowed = True

    def resume(self, m: float, c_r: float, c_l: float) -> float:
        """Return the u_d with which v stays where it is, for these parameters from now on."""
        if self.side is not GAP and self._play != (m, c_r, c_l):
            self._play = m, c_r, c_l
            self.extreme = self._u_at(self.v)
            self.taking_up = self._slowed = False
        return self.extreme

    def start_from(self, v: float) -> None:
        """Say which v acts before the next step, whatever was sent."""
        if v != self.v and self.side is not GAP:
            self.extreme = self._u_at(v)
        self.v = v

    def applied(self, v: float) -> None:
        """Say which v was really applied (limits), so that the next move starts from there."""
        self.limited = v != self.v
        if self.limited:
            # A v that was held back goes on its way although u_d rests.
            self.v, self.taking_up = v, True

    @property
    def held_u(self) -> float:
        """The u that is held while v is on its way across the gap, else the newest."""
        return self._u if self.taking_up else self.extreme

    def _u_at(self, v: float) -> float:
        m, c_r, c_l = self._play
        return m * (v - (c_r if self.side is RIGHT else c_l))

    def _note_on_the_way(self) -> None:
        """Note what v has made of u since it left for its line."""
        m, c_r, c_l = self._play
        self._u = clamp(self._u, m * (self.v - c_r), m * (self.v - c_l))
