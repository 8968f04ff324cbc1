"""Backlash inverse, equations (2.2) and (2.3), with a direction band and a slow take-up."""

from math import inf, nan

from backlash_ros.core.plant.backlash import GAP, LEFT, RIGHT, Region, clamp


class BacklashInverse:
    """v = BI(u_d): v crosses the gap when u_d turns; exact (2.2) with the true m, c_r, c_l.

    direction_band: u_d counts as turned once it is further than this behind its extreme; 0 gives
    the printed inverse. take_up: largest move of v per sample while it crosses the gap (2.3: "a
    line segment with a finite slope"), or moves to a line that new estimates have shifted.
    """

    def __init__(self, direction_band: float = 0.0, take_up: float = inf) -> None:
        self.direction_band, self.take_up = direction_band, take_up
        # v, the line in use (GAP until u_d first moves), and the furthest u_d on that line.
        self.v, self.side, self.extreme = 0.0, GAP, 0.0
        self.taking_up = False  # whether v is still on its way to the line
        self._slowed = False  # whether take_up limits v until it has reached u_d
        self.limited = False  # whether the limits have changed the last v
        self._play = nan, nan, nan  # m, c_r, c_l of the newest move
        self._u = 0.0  # the u that is held while v is on its way to a line

    def direction(self, u_d: float, band: float) -> Region:
        """Return the line for u_d: RIGHT if it goes up, LEFT if down, GAP if v is to be held."""
        move = u_d - self.extreme
        side = RIGHT if move > 0.0 else LEFT if move < 0.0 else GAP
        # Only a turn has to exceed the band; a move in the same direction is never noise.
        return side if band == 0.0 or side is self.side or abs(move) > band else GAP

    def step(
        self, u_d: float, m: float, c_r: float, c_l: float, band: float | None = None,
    ) -> float:
        """Return v(t) for u_d(t) and these parameters (2.3); band: instead of direction_band."""
        band = self.direction_band if band is None else band
        side = self.direction(u_d, band)
        if self.taking_up and self.side is not GAP:
            # u is held until v arrives: v turns back only if u_d is now behind that u.
            self._note_on_the_way()
            side = Region(-self.side) if (self._u - u_d) * self.side > band else self.side
        elif self.side is GAP and side is not GAP:
            self.side, self._u, self.taking_up = side, self.extreme, True
        return self.follow(side, u_d, m, c_r, c_l)

    def follow(self, side: Region, u_d: float, m: float, c_r: float, c_l: float) -> float:
        """Return v for u_d on the line of this side; v is held if u_d goes back on that line."""
        if side is GAP:
            return self.v
        if self.side is GAP:
            self._u = u_d  # the real u is not known yet
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
        """Make `proceed` lead v to u_d on the line of this side, whichever line it is on now."""
        self._u = self.held_u
        self.side, self.extreme, self.taking_up = side, u_d, True

    def proceed(self, m: float, c_r: float, c_l: float) -> float:
        """Return v one sample further on its way: no faster than take_up until it moves u."""
        if not self.taking_up:
            return self.v
        crossing = c_r if self.side is RIGHT else c_l
        # To where v begins to move u, or would stand already had these parameters been in use.
        way = (self.extreme if self._slowed else self._u) / m + crossing - self.v
        if abs(way) > self.take_up:
            self.v += self.take_up if way > 0.0 else -self.take_up
        else:
            self.v = self.extreme / m + crossing
            self.taking_up = self._slowed = False
        self._play = m, c_r, c_l
        return self.v

    def slow_down(self) -> None:
        """Limit v by take_up all the way to u_d, until it has arrived."""
        self.taking_up = self._slowed = True

    def resume(self, m: float, c_r: float, c_l: float) -> float:
        """Switch to these parameters, leaving v as it is; return the u_d that v now stands for."""
        if self.side is not GAP and self._play != (m, c_r, c_l):
            self._play = m, c_r, c_l
            self.extreme = self._u_at(self.v)
            self.taking_up = self._slowed = False
        return self.extreme

    def start_from(self, v: float) -> None:
        """Set the v that acts before the next step, whatever was sent."""
        if v != self.v and self.side is not GAP:
            self.extreme = self._u_at(v)
        self.v = v

    def applied(self, v: float) -> None:
        """Note the v that the limits let pass, from which the next move starts."""
        self.limited = v != self.v
        if self.limited:
            # A v that was held back continues even while u_d rests.
            self.v, self.taking_up = v, True

    @property
    def held_u(self) -> float:
        """The u that is held while v is on its way to its line, else the newest u_d on it."""
        return self._u if self.taking_up else self.extreme

    def _u_at(self, v: float) -> float:
        m, c_r, c_l = self._play
        return m * (v - (c_r if self.side is RIGHT else c_l))

    def _note_on_the_way(self) -> None:
        """Update the held u by the moves of v since it left for its line."""
        m, c_r, c_l = self._play
        self._u = clamp(self._u, m * (self.v - c_r), m * (self.v - c_l))
