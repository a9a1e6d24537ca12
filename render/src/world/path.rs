//! Plane curves made of straight lines and circular arcs, parametrised by arc length (f64, metres).

use glam::DVec2;

/// One line (`curvature` 0) or arc; positive curvature turns left.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Piece {
    pub start: DVec2,
    pub heading: f64,
    /// Unit vector of `heading`.
    pub dir: DVec2,
    pub length: f64,
    pub curvature: f64,
    /// Arc length of the path where this piece starts.
    pub s: f64,
}

/// A place on a path.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PathPoint {
    pub pos: DVec2,
    pub heading: f64,
    pub curvature: f64,
}

impl PathPoint {
    pub(crate) fn dir(&self) -> DVec2 {
        DVec2::from_angle(self.heading)
    }

    /// Unit normal to the left.
    pub(crate) fn left(&self) -> DVec2 {
        self.dir().perp()
    }
}

impl Piece {
    /// The point `u` metres along (lines and arcs in one formula: a chord of length u sinc(k u / 2) at the mean heading).
    fn at(&self, u: f64) -> PathPoint {
        let half = 0.5 * self.curvature * u;
        let sinc = if half.abs() < 1e-4 { 1.0 - half * half / 6.0 } else { half.sin() / half };
        let pos = self.start + DVec2::from_angle(self.heading + half) * (u * sinc);
        PathPoint { pos, heading: self.heading + 2.0 * half, curvature: self.curvature }
    }
}

/// A chain of pieces, tangent-continuous; outside its ends it goes on straight.
#[derive(Debug, Clone)]
pub(crate) struct Path {
    start: DVec2,
    heading: f64,
    pieces: Vec<Piece>,
}

impl Path {
    pub(crate) fn new(start: DVec2, heading: f64) -> Self {
        Self { start, heading, pieces: Vec::new() }
    }

    pub(crate) fn pieces(&self) -> &[Piece] {
        &self.pieces
    }

    pub(crate) fn length(&self) -> f64 {
        self.pieces.last().map_or(0.0, |p| p.s + p.length)
    }

    pub(crate) fn end(&self) -> PathPoint {
        match self.pieces.last() {
            Some(p) => p.at(p.length),
            None => PathPoint { pos: self.start, heading: self.heading, curvature: 0.0 },
        }
    }

    /// Appends a piece tangent to the end; pieces without length are left out.
    pub(crate) fn push(&mut self, length: f64, curvature: f64) {
        if length > 1e-9 {
            let end = self.end();
            let s = self.length();
            self.pieces.push(Piece { start: end.pos, heading: end.heading, dir: end.dir(), length, curvature, s });
        }
    }

    pub(crate) fn at(&self, s: f64) -> PathPoint {
        let i = self.pieces.partition_point(|p| p.s <= s).saturating_sub(1);
        let Some(p) = self.pieces.get(i) else {
            let pos = self.start + DVec2::from_angle(self.heading) * s;
            return PathPoint { pos, heading: self.heading, curvature: 0.0 };
        };
        let u = s - p.s;
        let inside = u.clamp(0.0, p.length);
        let mut point = p.at(inside);
        if u != inside {
            point.pos += point.dir() * (u - inside);
            point.curvature = 0.0;
        }
        point
    }

    /// The parallel curve `d` metres to the left.
    pub(crate) fn offset(&self, d: f64) -> Self {
        let start = self.start + DVec2::from_angle(self.heading).perp() * d;
        let mut out = Self::new(start, self.heading);
        for p in &self.pieces {
            let stretch = (1.0 - p.curvature * d).max(1e-3);
            out.push(p.length * stretch, p.curvature / stretch);
        }
        out
    }

    pub(crate) fn reversed(&self) -> Self {
        let end = self.end();
        let mut out = Self::new(end.pos, end.heading + std::f64::consts::PI);
        for p in self.pieces.iter().rev() {
            out.push(p.length, -p.curvature);
        }
        out
    }

    /// Arc length and left offset of the nearest point whose normal passes through `p`; `None` beyond both ends.
    pub(crate) fn project(&self, p: DVec2) -> Option<(f64, f64)> {
        let mut best: Option<(f64, f64)> = None;
        for piece in &self.pieces {
            let dir = piece.dir;
            let (u, d) = if piece.curvature == 0.0 {
                let v = p - piece.start;
                (v.dot(dir), dir.perp_dot(v))
            } else {
                let radius = 1.0 / piece.curvature;
                let centre = piece.start + dir.perp() * radius;
                let (from, to) = (piece.start - centre, p - centre);
                let angle = from.perp_dot(to).atan2(from.dot(to));
                (angle * radius, (radius.abs() - to.length()) * radius.signum())
            };
            if (-1e-6..=piece.length + 1e-6).contains(&u) && best.is_none_or(|b| d.abs() < b.1.abs()) {
                best = Some((piece.s + u, d));
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn snake(a: f64, k: f64, b: f64) -> Path {
        let mut path = Path::new(DVec2::new(3.0, -2.0), 0.4);
        path.push(a, 0.0);
        path.push(b, k);
        path.push(a, 0.0);
        path.push(b, -k);
        path
    }

    proptest! {
        #[test]
        fn unit_speed_offset_reverse_and_project_agree(a in 5.0..60.0f64, k in -0.08..0.08f64, b in 2.0..15.0f64, f in 0.01..0.99f64, d in -5.0..5.0f64) {
            let path = snake(a, k, b);
            let s = f * path.length();
            let (p, q) = (path.at(s), path.at(s + 1e-5));
            // A central difference of arc length: rounding of 1e-16 * 100 m over 1e-5 m.
            prop_assert!(((q.pos - p.pos).length() / 1e-5 - 1.0).abs() < 1e-7);
            let back = path.reversed();
            prop_assert!(back.at(path.length() - s).pos.distance(p.pos) < 1e-9);
            let beside = p.pos + p.left() * d;
            let (ps, pd) = path.project(beside).unwrap();
            // Another piece may come as near; the projection must never be farther than the true offset.
            prop_assert!(pd.abs() <= d.abs() + 1e-9);
            if (pd - d).abs() < 1e-9 { prop_assert!((ps - s).abs() < 1e-6); }
            let lane = path.offset(d);
            let (ls, ld) = lane.project(beside).unwrap();
            prop_assert!(ld.abs() < 1e-9, "{ls} {ld}");
        }
    }
}
