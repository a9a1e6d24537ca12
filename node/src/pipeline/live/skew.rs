//! Tells a camera that lags behind the others from a clock that jumped.
//!
//! In a recording images come in the order they were taken, nearly; live each camera has a connection of its own, and after
//! a stall one may deliver seconds ahead of another. To the synchronizer a stamp that far back is a clock jump, which
//! starts everything anew. But where the clock jumps, a camera's stamps go back against its own; where a camera lags, only
//! against the others'.

use crate::config::SyncConfig;
use crate::sync::clock::unsigned_ns;

/// Follows the newest stamp of every camera.
#[derive(Debug)]
pub struct SkewGate {
    back_ns: u64,
    own_ns: Vec<Option<i64>>,
    newest_ns: Option<i64>,
}

impl SkewGate {
    /// For so many cameras; `jump_back_sec` is what counts as far back.
    pub fn new(cameras: usize, config: &SyncConfig) -> Self {
        Self { back_ns: unsigned_ns(config.jump_back_sec), own_ns: vec![None; cameras], newest_ns: None }
    }

    /// Whether an image is of use: false for one that is far behind other cameras' and not behind its own.
    pub fn admits(&mut self, camera: usize, stamp_ns: i64) -> bool {
        let Some(own_ns) = self.own_ns.get_mut(camera) else { return true };
        let far_behind = |of_ns: i64| stamp_ns < of_ns && stamp_ns.abs_diff(of_ns) > self.back_ns;
        if own_ns.is_some_and(far_behind) {
            // Against its own stamps: the clock has jumped (or the stamp is a stray), the synchronizer finds out which.
            (*own_ns, self.newest_ns) = (Some(stamp_ns), Some(stamp_ns));
            return true;
        }
        *own_ns = Some(own_ns.map_or(stamp_ns, |n| n.max(stamp_ns)));
        if self.newest_ns.is_some_and(far_behind) {
            return false;
        }
        self.newest_ns = Some(self.newest_ns.map_or(stamp_ns, |n| n.max(stamp_ns)));
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEC: i64 = 1_000_000_000;

    #[test]
    fn a_camera_that_lags_is_no_jump_and_a_jump_is_no_lag() {
        let mut gate = SkewGate::new(2, &SyncConfig::default());
        assert!((0..50).all(|i| gate.admits(0, 100 * SEC + i * SEC / 10)), "camera 0 runs ahead");
        assert!(!gate.admits(1, 100 * SEC) && !gate.admits(1, 103 * SEC), "camera 1 is too late");
        assert!(gate.admits(1, 104 * SEC) && gate.admits(1, 105 * SEC), "and catches up");
        assert!(gate.admits(0, 50 * SEC), "camera 0 jumps");
        assert!(gate.admits(1, 50 * SEC), "so does camera 1");
        assert!(gate.admits(0, 50 * SEC + SEC / 10) && gate.admits(1, 50 * SEC + SEC / 10));
        assert!(gate.admits(7, 0), "not one of ours: somebody else's matter");
    }
}
