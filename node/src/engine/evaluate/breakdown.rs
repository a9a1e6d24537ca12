//! Where the error is: by distance, by class of road user, by kind of mover, in the velocity bases, and in the images by what would
//! mend it. Everything is pooled over pixels, so that shares add up; the figures of the main table are means over timesteps.

use serde::Serialize;
use storm_model::metrics::bases::{BaseFigures, BaseSpread};
use storm_model::metrics::flow::{AV2_DYNAMIC_MPS, Flow};
use storm_model::metrics::mends::{MendMeans, Mends};
use storm_model::metrics::movers::{KindShare, MoverErrors, MoverFigures};
use storm_model::metrics::{Mean, MetricError};
use storm_render::world::MoverClass;

/// Where bins of z-depth end, metres; the last has no end.
const DISTANCES_M: [f32; 4] = [10.0, 25.0, 50.0, f32::INFINITY];

/// Classes that are told apart.
const CLASSES: [&str; 4] = ["car", "van, lorry, bus", "cyclist", "pedestrian"];

/// The row of [`CLASSES`] a class belongs to.
fn class_row(class: MoverClass) -> usize {
    match class {
        MoverClass::Car => 0,
        MoverClass::Van | MoverClass::Lorry | MoverClass::Bus => 1,
        MoverClass::Cyclist => 2,
        MoverClass::Pedestrian => 3,
    }
}

fn distance_row(depth: f32) -> usize {
    DISTANCES_M.iter().position(|&end| depth < end).unwrap_or(DISTANCES_M.len() - 1)
}

/// Errors of the pixels of one kind.
#[derive(Debug, Clone, Copy, Default)]
struct Bin {
    movers: MoverErrors,
    /// End-point error of road users that stand still, m/s.
    still: Mean,
    /// Depth error over the true depth.
    depth: Mean,
    /// Squared colour error of held-out pixels' channels.
    color: Mean,
}

impl Bin {
    fn join(&mut self, other: &Self) {
        self.movers.join(&other.movers);
        self.still.join(&other.still);
        self.depth.join(&other.depth);
        self.color.join(&other.color);
    }
}

/// Figures of the pixels of one kind; `None` where there are none.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BinFigures {
    /// Which pixels.
    pub name: String,
    /// Share of all movers' pixels, 0-1.
    pub movers_share: Option<f64>,
    /// Share of all movers' summed end-point error, 0-1.
    pub error_share: Option<f64>,
    /// Mean end-point error of road users at 0.5 m/s or faster, m/s.
    pub epe3d_moving: Option<f64>,
    /// Mean end-point error of other road users, m/s.
    pub epe3d_still: Option<f64>,
    /// Share of movers' pixels that are missed, 0-1.
    pub missed_share: Option<f64>,
    /// Mean absolute depth error over the true depth.
    pub depth_relative: Option<f64>,
    /// PSNR over all held-out pixels of the kind together, dB.
    pub psnr: Option<f64>,
}

/// One pixel of a context frame with known flow and depth.
pub(super) struct FlowPixel {
    pub pred: Flow,
    pub truth: Flow,
    /// True z-depth, metres.
    pub depth: f32,
    /// Predicted z-depth, where the method has one.
    pub pred_depth: Option<f32>,
    /// Whether it shows a road user, where that is known.
    pub user: bool,
    /// Of which class.
    pub class: Option<MoverClass>,
}

/// Sums over many clips.
#[derive(Debug, Clone, Default)]
pub(super) struct Breakdown {
    movers: MoverErrors,
    by_distance: [Bin; 4],
    by_class: [Bin; 4],
    bases: BaseSpread,
    mends: MendMeans,
}

/// The figures of `Breakdown`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct BreakdownFigures {
    /// Movers (road users at 0.5 m/s or faster), all together.
    pub movers: MoverFigures,
    /// Of which kinds their pixels and their error are.
    pub kinds: Vec<KindShare>,
    /// The velocity bases.
    pub bases: BaseFigures,
    /// By z-depth.
    pub by_distance: Vec<BinFigures>,
    /// By class of road user; empty where no class is known.
    pub by_class: Vec<BinFigures>,
    /// What would gain how much PSNR.
    pub mends: Mends,
}

impl Breakdown {
    /// Counts a pixel of a context frame; `index` is for error messages.
    pub fn flow(&mut self, index: usize, pixel: &FlowPixel) -> Result<(), MetricError> {
        let speed = pixel.truth.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
        let moving = pixel.user && speed >= AV2_DYNAMIC_MPS;
        if moving {
            self.movers.add(index, pixel.pred, pixel.truth)?;
        }
        let distance = self.by_distance.get_mut(distance_row(pixel.depth));
        let class = pixel.class.and_then(|class| self.by_class.get_mut(class_row(class)));
        for bin in distance.into_iter().chain(class) {
            if moving {
                bin.movers.add(index, pixel.pred, pixel.truth)?;
            } else if pixel.user {
                let apart = pixel.pred.iter().zip(pixel.truth).map(|(p, t)| f64::from(p - t).powi(2)).sum::<f64>();
                bin.still.add(Some(apart.sqrt()));
            }
            let error = |pred: f32| f64::from((pred - pixel.depth).abs()) / f64::from(pixel.depth);
            bin.depth.add(pixel.pred_depth.map(error));
        }
        Ok(())
    }

    /// Counts a held-out pixel of known depth, colours 0-1.
    pub fn color(&mut self, pred: &[f32], truth: &[f32], depth: f32, class: Option<MoverClass>) {
        let distance = self.by_distance.get_mut(distance_row(depth));
        let class = class.and_then(|class| self.by_class.get_mut(class_row(class)));
        for bin in distance.into_iter().chain(class) {
            pred.iter().zip(truth).for_each(|(p, t)| bin.color.add(Some(f64::from(p - t).powi(2))));
        }
    }

    /// Counts a held-out image.
    pub fn mends(&mut self, image: Option<Mends>) {
        image.iter().for_each(|image| self.mends.add(image));
    }

    /// The bases of a network's scenes.
    pub fn bases(&mut self) -> &mut BaseSpread {
        &mut self.bases
    }

    /// Counts what the other counted too.
    pub fn join(&mut self, other: &Self) {
        self.movers.join(&other.movers);
        let bins = self.by_distance.iter_mut().chain(&mut self.by_class);
        bins.zip(other.by_distance.iter().chain(&other.by_class)).for_each(|(bin, other)| bin.join(other));
        self.bases.join(&other.bases);
        self.mends.join(&other.mends);
    }

    /// Movers, all together.
    pub fn movers(&self) -> MoverFigures {
        self.movers.figures()
    }

    /// The figures so far.
    pub fn figures(&self) -> BreakdownFigures {
        let all = self.movers.figures();
        let bin = |name: String, bin: &Bin| {
            let movers = bin.movers.figures();
            let share = |part: f64, whole: f64| (whole > 0.0).then(|| part / whole);
            BinFigures {
                name,
                movers_share: share(movers.pixels as f64, all.pixels as f64),
                error_share: share(bin.movers.sum(), self.movers.sum()),
                epe3d_moving: movers.epe3d,
                epe3d_still: bin.still.value(),
                missed_share: movers.missed_share,
                depth_relative: bin.depth.value(),
                psnr: bin.color.value().filter(|mse| *mse > 0.0).map(|mse| -10.0 * mse.log10()),
            }
        };
        let distance = |k: usize| match (k.checked_sub(1).map_or(0.0, |before| DISTANCES_M[before]), DISTANCES_M[k]) {
            (from, to) if to.is_finite() => format!("{from}-{to} m"),
            (from, _) => format!("{from} m and beyond"),
        };
        let known = |bin: &Bin| bin.depth.count() > 0 || bin.color.count() > 0 || bin.movers.figures().pixels > 0;
        let classes = self.by_class.iter().zip(CLASSES).filter(|(b, _)| known(b));
        let distances = self.by_distance.iter().enumerate().filter(|(_, b)| known(b));
        BreakdownFigures {
            movers: all,
            kinds: self.movers.shares(),
            bases: self.bases.figures(),
            by_distance: distances.map(|(k, b)| bin(distance(k), b)).collect(),
            by_class: classes.map(|(b, name)| bin(name.into(), b)).collect(),
            mends: self.mends.means(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(depth: f32, speed: f32, class: MoverClass) -> FlowPixel {
        let truth = [speed, 0.0, 0.0];
        FlowPixel { pred: [0.5, 0.0, 0.0], truth, depth, pred_depth: Some(1.5 * depth), user: true, class: Some(class) }
    }

    #[test]
    fn errors_fall_into_the_bins_of_their_pixels() {
        let mut a = Breakdown::default();
        a.flow(0, &pixel(5.0, 8.5, MoverClass::Car)).unwrap();
        a.flow(1, &pixel(10.0, 2.5, MoverClass::Lorry)).unwrap();
        let mut b = Breakdown::default();
        b.flow(2, &pixel(400.0, 0.0, MoverClass::Pedestrian)).unwrap();
        b.flow(3, &FlowPixel { user: false, class: None, ..pixel(30.0, 0.0, MoverClass::Car) }).unwrap();
        b.color(&[0.1; 3], &[0.2; 3], 60.0, None);
        a.join(&b);
        let f = a.figures();
        let names: Vec<&str> = f.by_distance.iter().chain(&f.by_class).map(|b| b.name.as_str()).collect();
        let wanted = ["0-10 m", "10-25 m", "25-50 m", "50 m and beyond", "car", "van, lorry, bus", "pedestrian"];
        assert_eq!(names, wanted);
        let near = &f.by_distance[0];
        assert_eq!((near.movers_share, near.error_share), (Some(0.5), Some(0.8)));
        assert_eq!((near.epe3d_moving, near.missed_share, near.depth_relative), (Some(8.0), Some(1.0), Some(0.5)));
        let far = &f.by_distance[3];
        assert_eq!((far.epe3d_still, far.epe3d_moving), (Some(0.5), None));
        assert!((far.psnr.unwrap() - 20.0).abs() < 1e-5, "{far:?}");
        // The surroundings are in the bin of their distance alone, and no road users.
        assert_eq!((f.by_distance[2].epe3d_still, f.by_distance[2].depth_relative), (None, Some(0.5)));
        assert_eq!((f.movers.pixels, f.movers.missed_share, f.movers.epe3d), (2, Some(1.0), Some(5.0)));
        assert_eq!(f.by_class[1].epe3d_moving, Some(2.0));
    }

    #[test]
    fn nothing_is_no_figure() {
        let f = Breakdown::default().figures();
        assert!(f.by_distance.is_empty() && f.by_class.is_empty() && f.kinds.is_empty());
        assert_eq!(f, BreakdownFigures::default());
    }
}
