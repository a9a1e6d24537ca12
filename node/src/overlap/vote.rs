//! Where the other pictures bear out both stories, neighbours and the motion group decide: a bus's side moves since its
//! ends do. Where those say nothing it stands, as most surfaces do. Where the pictures bear out neither (the place has
//! just come into view), neighbours alone may say that it stands.

use rayon::prelude::*;
use storm_model::scene::Scene;

use super::hypotheses::{Picture, Verdict};

/// Neighbours up to so many pixels away have a vote.
const REACH: usize = 3;
/// Neighbours whose depth differs by more than this part are of another surface.
const SAME_SURFACE: f32 = 0.1;
/// A motion group votes when at least this many of its Gaussians in the window are settled.
const GROUP_LEAST: usize = 8;

/// Settled votes: stands, moves.
type Votes = (usize, usize);

/// Per Gaussian, whether it is said to move and stands.
pub(super) fn stilled(scene: &Scene, verdicts: &[Verdict], pictures: &[Picture]) -> Vec<bool> {
    let groups = groups(scene, verdicts);
    let pixels = scene.shape.width * scene.shape.height;
    pictures
        .par_iter()
        .flat_map_iter(|picture| {
            let own = &verdicts[picture.first..picture.first + pixels];
            let groups = &groups;
            (0..pixels).map(move |p| {
                let verdict = &own[p];
                if !verdict.claimed || verdict.moves() {
                    return false;
                }
                if verdict.stands() {
                    return true;
                }
                let near = near(scene, own, picture, p);
                if near.0 != near.1 || !verdict.either() {
                    return near.0 > near.1;
                }
                let group = match scene.gaussians.motion_count {
                    0 => None,
                    _ => groups.get(usize::from(scene.gaussians.motion_id(picture.first + p))),
                };
                let moves = |g: &Votes| g.0 + g.1 >= GROUP_LEAST && g.1 > g.0;
                !group.is_some_and(moves)
            })
        })
        .collect()
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

/// Settled votes of the same surface around a pixel.
fn near(scene: &Scene, verdicts: &[Verdict], picture: &Picture, p: usize) -> Votes {
    let (w, h) = (scene.shape.width, scene.shape.height);
    let (row, col, depth) = (p / w, p % w, picture.depth[p]);
    let mut votes = (0, 0);
    for r in row.saturating_sub(REACH)..(row + REACH + 1).min(h) {
        for c in col.saturating_sub(REACH)..(col + REACH + 1).min(w) {
            let i = r * w + c;
            if (picture.depth[i] - depth).abs() <= SAME_SURFACE * depth {
                votes.0 += usize::from(verdicts[i].stands());
                votes.1 += usize::from(verdicts[i].moves());
            }
        }
    }
    votes
}
