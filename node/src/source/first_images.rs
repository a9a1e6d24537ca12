//! A camera's first images, looked at for a black frame before anything is made of them.

use crate::bag::{Bag, BagError};
use crate::cdr::decode as cdr;
use crate::decode::{self, BlackFrame, FrameFinder};
use crate::pipeline::guard::caught;

use super::topics::TopicPlan;

/// Shows a camera's next image message to its finder; one that cannot be read is passed over (it is counted where it is used).
pub fn look_at(finder: &mut FrameFinder, compressed: bool, data: &[u8]) {
    let read = caught(|| {
        Some(if compressed {
            let image = cdr::compressed_image(data).ok()?;
            (image.header.stamp_ns, decode::compressed_to_rgb(&image).ok()?)
        } else {
            let image = cdr::image(data).ok()?;
            (image.header.stamp_ns, decode::image_to_rgb(&image).ok()?)
        })
    });
    if let Ok(Some((stamp_ns, image))) = read {
        finder.look(stamp_ns, &image, compressed);
    }
}

/// The black frames of a bag's cameras, in order. Reads as far as it must: a camera whose first image has no black border is done
/// with that one.
pub(super) fn black_frames(bag: &Bag, plan: &TopicPlan) -> Result<Vec<Option<BlackFrame>>, BagError> {
    let mut finders: Vec<FrameFinder> = plan.cameras.iter().map(|_| FrameFinder::default()).collect();
    let mut wanted: Vec<usize> = plan.cameras.iter().map(|c| c.image).collect();
    wanted.sort_unstable();
    wanted.dedup();
    for message in bag.messages(&wanted)? {
        let Ok(m) = message else { continue };
        for (finder, camera) in finders.iter_mut().zip(&plan.cameras) {
            if camera.image == m.topic && !finder.settled() {
                look_at(finder, camera.compressed, &m.data);
            }
        }
        if finders.iter().all(FrameFinder::settled) {
            break;
        }
    }
    Ok(finders.iter().map(FrameFinder::found).collect())
}
