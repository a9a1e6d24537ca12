//! A window down the ladder: taken again, moved on, approximated, or computed in full.

use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use storm_model::scene::{RenderedView, Scene, Want};
use tracing::debug;

use super::{Part, Ran, Step, StepMaker, newest_time_sec};
use crate::engine::views_of;
use crate::gate::contract::{Difference, Notch, Verdict};
use crate::gate::predict::{explains, moved_on, pixel_flow};
use crate::gate::skipper::{Computed, Plan, Shadow, UNLIKE, difference};
use crate::pipeline::demand::Demand;
use crate::rigid::Rigid;
use crate::source::Frame;
use crate::sync::clock::seconds_between;
use crate::window::Window;

/// A prediction of a window from the last computed one.
struct Predicted {
    /// The new window, in the computed one's anchor.
    window: Window<Frame>,
    views: Vec<RenderedView>,
}

impl StepMaker {
    /// The same, with no more than `demand` asks for. A window that shows what the last computed one showed takes its result, one
    /// that it explains once moved on takes it extrapolated (see [`crate::gate`]).
    pub fn run_for(&mut self, window: Window<Frame>, demand: Demand) -> Result<Option<Step>> {
        let stamp_ns = window.stamp_ns;
        Ok(self.guarded(stamp_ns, |s| s.run_parts(window, demand))?.flatten())
    }

    fn run_parts(&mut self, window: Window<Frame>, demand: Demand) -> Result<Option<Step>> {
        self.enter(Part::Gate);
        let plan = self.timings.time("gate", || self.skipper.plan(&window, demand));
        let shadow = match plan {
            Plan::Reuse(again) => return Ok(Some(self.again(window, again, demand))),
            Plan::Predict(last) => match self.predict(&window, &last, demand) {
                None => {
                    self.skipper.unexplained();
                    None
                }
                Some(predicted) => match self.skipper.explained() {
                    Verdict::Skip => return Ok(Some(self.extrapolated(predicted, &last, demand))),
                    Verdict::Check => Some(Shadow {
                        notch: Notch::Predicted,
                        approximate: last.approximate,
                        scene: last.scene,
                        views: predicted.views.into(),
                        map_from_anchor: last.window.map_from_anchor.rotation,
                    }),
                    Verdict::Full => None,
                },
            },
            Plan::Compute { shadow } => shadow,
        };
        let start = Instant::now();
        self.enter(Part::Network);
        // What a skipped step is compared with leaves nothing out.
        let verdict = match shadow {
            None if self.engine.approximates(&window, &self.cameras) => self.skipper.may_approximate(),
            _ => Verdict::Full,
        };
        if verdict == Verdict::Skip {
            let rough = self.engine.shortest_step(&window, &self.cameras);
            let ms = start.elapsed().as_secs_f64() * 1e3;
            let (map_from_anchor, scene) = match rough {
                Ok((anchor, scene)) => (anchor, Ok(scene)),
                Err(e) => (window.map_from_anchor, Err(e)),
            };
            let window = Window { map_from_anchor, ..window };
            return self.take_in(window, Ran { scene, ms, approximate: true }, demand, None);
        }
        // Before the exact step, from which the engine learns what is sky in this very window.
        let rough = (verdict == Verdict::Check).then(|| self.engine.shortest_step(&window, &self.cameras));
        let rough_ms = start.elapsed().as_secs_f64() * 1e3;
        let start = Instant::now();
        let scene = self.engine.exact_step(&window, &self.cameras);
        let ran = Ran { scene, ms: start.elapsed().as_secs_f64() * 1e3, approximate: false };
        if let (Some(rough), Ok(exact)) = (rough, &ran.scene) {
            let start = Instant::now();
            let found = self.apart(&window, exact, rough.as_ref().ok())?;
            self.timings.add("shadow", rough_ms + start.elapsed().as_secs_f64() * 1e3);
            self.skipper.approximated(found);
        }
        self.take_in(window, ran, demand, shadow.as_ref())
    }

    /// How an approximation, in the frame of its own anchor, compares with the exact step of the same window.
    fn apart(&mut self, window: &Window<Frame>, exact: &Scene, rough: Option<&(Rigid, Scene)>) -> Result<Difference> {
        let Some((rough_anchor, rough)) = rough else { return Ok(UNLIKE) };
        let newest = &window.steps[window.steps.len() - 1];
        let (time_sec, want) = (newest_time_sec(window), Want { flow: true, motion: false });
        let mut draw = |scene: &Scene, anchor: &Rigid| {
            self.engine.render(scene, &views_of(newest, anchor, &self.cameras), time_sec, want)
        };
        let (full, skipped) = (draw(exact, &window.map_from_anchor)?, draw(rough, rough_anchor)?);
        let turn = window.map_from_anchor.rotation.conjugate() * rough_anchor.rotation;
        Ok(difference(newest, &full, &skipped, turn.as_quat()))
    }

    /// The last computed step drawn at the window's newest time and poses, where that explains its pictures everywhere.
    fn predict(&mut self, window: &Window<Frame>, last: &Computed, demand: Demand) -> Option<Predicted> {
        let start = Instant::now();
        let then = &last.window;
        let first_ns = then.steps.first().map_or(then.stamp_ns, |s| s.stamp_ns);
        let targets = views_of(&window.steps[window.steps.len() - 1], &then.map_from_anchor, &self.cameras);
        let want = Want { flow: true, motion: demand.motion };
        let time_sec = seconds_between(first_ns, window.stamp_ns) as f32;
        let views = self.engine.render(&last.scene, &targets, time_sec, want);
        let found = views.ok().filter(|views| {
            let explained = explains(&self.config.skip, last, window, views, &self.cameras);
            if let Err(why) = explained {
                debug!("window at {} ns is not what was predicted: {why:?}", window.stamp_ns);
            }
            explained.is_ok()
        });
        self.timings.add("predict", start.elapsed().as_secs_f64() * 1e3);
        found.map(|views| Predicted {
            window: Window { map_from_anchor: then.map_from_anchor, ..window.clone() },
            views,
        })
    }

    /// A window that the last computed one explains: its Gaussians at the new time. The map is told nothing: there is nothing new.
    fn extrapolated(&mut self, predicted: Predicted, last: &Computed, demand: Demand) -> Step {
        let start = Instant::now();
        let Predicted { window, views } = predicted;
        let scene = Arc::new(moved_on(&last.scene, &last.window, &window));
        self.follow(&scene, &window, demand);
        let pixels = pixel_flow(&last.window, &window, &views, &self.cameras);
        let total_ms = start.elapsed().as_secs_f64() * 1e3 + self.timings.newest("predict");
        let now =
            Computed { window, scene, views: views.into(), agreement: Arc::clone(&last.agreement), ..last.clone() };
        let step = self.step(now, demand, Some(Notch::Predicted), total_ms);
        Step { pixels: Some(pixels), ..step }
    }

    /// A window that shows what `last` showed: its result, with the new stamps. The map is told nothing, having been told.
    fn again(&mut self, window: Window<Frame>, last: Computed, demand: Demand) -> Step {
        let start = Instant::now();
        // The cameras stand; where they stood is where the Gaussians are.
        let window = Window { map_from_anchor: last.window.map_from_anchor, ..window };
        self.follow(&last.scene, &window, demand);
        let total_ms = start.elapsed().as_secs_f64() * 1e3;
        self.step(Computed { window, ..last }, demand, Some(Notch::Still), total_ms)
    }
}
