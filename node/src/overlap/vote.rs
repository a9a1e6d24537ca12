//! Where the other pictures bear out both stories, neighbours and the motion group decide: a bus's side moves since its
//! ends do, the road stands since its kerbs do.

use rayon::prelude::*;
use storm_model::scene::Scene;

use super::hypotheses::Verdict;

/// Neighbours up to so many pixels away have a vote.
const REACH: usize = 3;
/// A motion group votes when at least this many of its Gaussians in the window are settled.
const GROUP_LEAST: usize = 8;

/// Settled votes: stands, moves.
type Votes = (usize, usize);

/// Per Gaussian, whether it is said to move and stands.
pub(super) fn stilled(scene: &Scene, verdicts: &[Verdict]) -> Vec<bool> {
    let shape = scene.shape;
    let (w, h) = (shape.width, shape.height);
    let groups = groups(scene, verdicts);
    let stands: Vec<bool> = (0..shape.timesteps * shape.cameras)
        .into_par_iter()
        .flat_map_iter(|k| {
            let first = k * w * h;
            let picture = &verdicts[first..first + w * h];
            let around = Sums::new(picture, w, h);
            let groups = &groups;
            (0..w * h).map(move |p| {
                let verdict = &picture[p];
                if !verdict.claimed || verdict.moves() {
                    return false;
                }
                if verdict.stands() {
                    return true;
                }
                let near = around.near(p / w, p % w);
                let group = match near.0 == near.1 && verdict.either() && scene.gaussians.motion_count > 0 {
                    true => groups.get(usize::from(scene.gaussians.motion_id(first + p))).copied().unwrap_or_default(),
                    false => (0, 0),
                };
                // Nobody near: of one who is not known at all the group says nothing.
                near.0 > near.1 || (near.0 == near.1 && group.0 + group.1 >= GROUP_LEAST && group.0 > group.1)
            })
        })
        .collect();
    stands
}

/// Settled votes of every motion group.
fn groups(scene: &Scene, verdicts: &[Verdict]) -> Vec<Votes> {
    let mut votes = vec![(0, 0); scene.gaussians.motion_count];
    if votes.is_empty() {
        return votes;
    }
    for (i, v) in verdicts.iter().enumerate().filter(|(_, v)| v.claimed) {
        let group = &mut votes[usize::from(scene.gaussians.motion_id(i))];
        group.0 += usize::from(v.stands());
        group.1 += usize::from(v.moves());
    }
    votes
}

/// Sums over rectangles of a picture's settled votes.
struct Sums {
    width: usize,
    height: usize,
    /// `(height + 1) x (width + 1)`: votes above and left of a corner.
    corners: Vec<[u32; 2]>,
}

impl Sums {
    fn new(picture: &[Verdict], width: usize, height: usize) -> Self {
        let stride = width + 1;
        let mut corners = vec![[0; 2]; stride * (height + 1)];
        for r in 0..height {
            let mut row = [0; 2];
            for c in 0..width {
                let v = &picture[r * width + c];
                row[0] += u32::from(v.stands());
                row[1] += u32::from(v.moves());
                let above = corners[r * stride + c + 1];
                corners[(r + 1) * stride + c + 1] = [above[0] + row[0], above[1] + row[1]];
            }
        }
        Self { width, height, corners }
    }

    fn near(&self, row: usize, col: usize) -> Votes {
        let stride = self.width + 1;
        let (r0, r1) = (row.saturating_sub(REACH), (row + REACH + 1).min(self.height));
        let (c0, c1) = (col.saturating_sub(REACH), (col + REACH + 1).min(self.width));
        let at = |r: usize, c: usize, k: usize| self.corners[r * stride + c][k];
        let sum = |k: usize| (at(r1, c1, k) + at(r0, c0, k) - at(r0, c1, k) - at(r1, c0, k)) as usize;
        (sum(0), sum(1))
    }
}
