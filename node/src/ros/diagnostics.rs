//! `/diagnostics`, once a second: what comes in, what is done with it, what is lost and why.

use crate::msg::DiagnosticStatus;
use crate::pipeline::live::Status;
use crate::pipeline::timing::{peak_rss_mb, rss_mb};
use crate::sync::DropReason;

const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

/// One input as the node sees it.
#[derive(Debug, Clone, Default)]
pub struct InputReport {
    /// Its topic.
    pub topic: String,
    /// Messages since the start.
    pub received: u64,
    /// Messages at the last report.
    pub reported: u64,
    /// Messages a second, over the last report.
    pub rate_hz: f64,
    /// Whether the watchdog calls it silent.
    pub silent: bool,
    /// A picture or a pose: without it nothing goes on.
    pub vital: bool,
    /// Why a publisher of it does not match, if one does not.
    pub mismatch: Option<String>,
}

/// All there is to say at one moment.
#[derive(Debug, Clone, Default)]
pub struct Report<'a> {
    /// The node's full name.
    pub node: &'a str,
    /// What the node waits for before it starts; empty once it runs.
    pub waiting: &'a str,
    /// The inputs.
    pub inputs: &'a [InputReport],
    /// The pipeline now and at the last report; none before it runs.
    pub status: Option<(&'a Status, &'a Status)>,
    /// Subscriptions of each output topic; none before it runs.
    pub outputs: &'a [(String, usize)],
    /// Device and weights.
    pub device: String,
    /// Now, of the clock that stamps are of, nanoseconds.
    pub now_ns: i64,
    /// Whether the map is kept.
    pub map: bool,
}

impl Report<'_> {
    /// The statuses.
    pub fn statuses(&self) -> Vec<DiagnosticStatus> {
        let mut all = vec![self.inputs()];
        if let Some((now, before)) = self.status {
            all.push(self.pipeline(now, before));
            all.push(self.losses(now, before));
            all.push(self.outputs());
            if self.map {
                all.push(self.map(now));
            }
        }
        all
    }

    fn status(&self, part: &str, level: u8, message: String, values: Vec<(String, String)>) -> DiagnosticStatus {
        let name = format!("{}: {part}", self.node.trim_start_matches('/'));
        DiagnosticStatus { level, name, message, hardware_id: self.device.clone(), values }
    }

    fn inputs(&self) -> DiagnosticStatus {
        let mut values = Vec::new();
        let (mut silent, mut mismatched) = (Vec::new(), Vec::new());
        for i in self.inputs {
            values.push((format!("{} rate (Hz)", i.topic), format!("{:.1}", i.rate_hz)));
            values.push((format!("{} messages", i.topic), i.received.to_string()));
            if let Some(why) = &i.mismatch {
                mismatched.push(format!("{}: {why}", i.topic));
                values.push((format!("{} QoS", i.topic), why.clone()));
            }
            if i.vital && i.silent {
                silent.push(i.topic.as_str());
            }
        }
        let (level, message) = if !mismatched.is_empty() {
            (ERROR, format!("QoS mismatch: {}", mismatched.join("; ")))
        } else if !self.waiting.is_empty() {
            (WARN, format!("waiting: {}", self.waiting))
        } else if !silent.is_empty() {
            (ERROR, format!("stopped: {}", silent.join(", ")))
        } else {
            (OK, "all inputs come in".into())
        };
        self.status("inputs", level, message, values)
    }

    fn pipeline(&self, now: &Status, before: &Status) -> DiagnosticStatus {
        let lag_ms = now.stamp_ns.map(|stamp_ns| self.now_ns.saturating_sub(stamp_ns) as f64 * 1e-6);
        let ms = |x: Option<f64>| x.map_or_else(|| "-".into(), |x| format!("{x:.1}"));
        let mut values = vec![
            ("steps".into(), now.steps.to_string()),
            ("steps since the last report".into(), (now.steps - before.steps.min(now.steps)).to_string()),
            ("hop (s)".into(), format!("{:.3}", now.hop_sec)),
            ("age of the newest step (ms)".into(), ms(lag_ms)),
            ("latency p50 (ms)".into(), ms(now.latency_quantile_ms(0.5))),
            ("latency p99 (ms)".into(), ms(now.latency_quantile_ms(0.99))),
            ("Gaussians".into(), now.gaussians.to_string()),
            ("trajectories".into(), now.tracks.to_string()),
            ("objects".into(), now.objects.to_string()),
            ("cameras in use".into(), format!("{:?}", now.active)),
            ("clock jumps and resets".into(), now.epochs.to_string()),
            ("memory (MB)".into(), ms(rss_mb())),
            ("peak memory (MB)".into(), ms(peak_rss_mb())),
        ];
        values.extend(now.stages_ms.iter().map(|(stage, x)| (format!("{stage} (ms)"), format!("{x:.1}"))));
        let skipped = now.superseded.saturating_sub(before.superseded);
        let failed = now.failed_steps.saturating_sub(before.failed_steps);
        let all_panics = |s: &Status| s.panicked_steps + s.panics;
        let panics = all_panics(now).saturating_sub(all_panics(before));
        let (level, message) = if panics > 0 {
            (ERROR, format!("{panics} panics; the stages were started anew"))
        } else if failed > 0 {
            (ERROR, format!("{failed} steps failed"))
        } else if now.paused {
            (OK, "paused".into())
        } else if skipped > 0 {
            (WARN, format!("cannot keep up: {skipped} sets skipped for newer ones, a step every {:.2} s", now.hop_sec))
        } else if now.steps == before.steps {
            (WARN, "no step since the last report".into())
        } else {
            (OK, format!("a step every {:.2} s", now.hop_sec))
        };
        self.status("pipeline", level, message, values)
    }

    fn losses(&self, now: &Status, before: &Status) -> DiagnosticStatus {
        let mut values: Vec<(String, String)> =
            [("images in", now.images_in), ("images used", now.images_used), ("sets", now.sets)]
                .map(|(what, n)| (what.into(), n.to_string()))
                .into();
        for reason in DropReason::ALL {
            values.push((format!("images dropped, {reason}"), now.drops.get(reason).to_string()));
        }
        let w = &now.windows;
        for (what, n) in [
            ("images while paused", now.paused_images),
            ("sets skipped, superseded", now.superseded),
            ("sets skipped, hop", w.hop),
            ("sets skipped, filling", w.filling),
            ("sets skipped, gap", w.gap),
            ("sets refused, out_of_order", w.out_of_order),
            ("sets refused, malformed", w.malformed),
            ("steps skipped, nothing changed", now.skips.still),
            ("steps skipped, predicted", now.skips.predicted),
            ("steps approximated", now.skips.approximate),
            ("skipped steps checked", now.skips.checks),
            ("checks that found a difference", now.skips.broken),
            ("level (0 exact, 1 still, 2 predicted, 3 approximate)", now.skips.level as u64),
            ("still steps between checks", now.skips.notches[0].level),
            ("predicted steps between checks", now.skips.notches[1].level),
            ("approximate steps between checks", now.skips.notches[2].level),
            ("windows not finite", now.non_finite_windows),
            ("windows lost to a panic", now.panicked_steps),
            ("panics of other stages", now.panics),
            ("saves of the map failed", now.failed_saves),
            ("steps failed", now.failed_steps),
            ("outputs failed", now.failed_outputs),
            ("poses refused", now.poses_rejected),
            ("messages unreadable", now.messages_lost),
            ("messages dropped", now.messages_dropped),
        ] {
            values.push((what.into(), n.to_string()));
        }
        let fresh = now.drops.total().saturating_sub(before.drops.total());
        let (level, message) = match fresh {
            0 => (OK, "nothing lost since the last report".into()),
            n => {
                let lost = |r: &DropReason| now.drops.get(*r) > before.drops.get(*r);
                let reasons: Vec<&str> = DropReason::ALL.iter().filter(|r| lost(r)).map(|r| r.as_str()).collect();
                (WARN, format!("{n} images dropped: {}", reasons.join(", ")))
            }
        };
        self.status("losses", level, message, values)
    }

    fn outputs(&self) -> DiagnosticStatus {
        let values = self.outputs.iter().map(|(topic, n)| (format!("{topic} subscriptions"), n.to_string())).collect();
        let heard = self.outputs.iter().filter(|(_, n)| *n > 0).count();
        let message = match heard {
            0 => "nobody listens: steps are run, nothing is sent".into(),
            n => {
                format!("{n} of {} topics are listened to; what nobody listens to is not computed", self.outputs.len())
            }
        };
        self.status("outputs", OK, message, values)
    }

    fn map(&self, now: &Status) -> DiagnosticStatus {
        let values = vec![
            ("Gaussians".into(), now.map_gaussians.to_string()),
            ("memory (MiB)".into(), format!("{:.1}", now.map_mb)),
            ("evicted".into(), now.map_evicted.to_string()),
        ];
        self.status("map", OK, format!("{} Gaussians", now.map_gaussians), values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn level_of(statuses: &[DiagnosticStatus], part: &str) -> (u8, String) {
        let s = statuses.iter().find(|s| s.name.ends_with(part)).unwrap();
        (s.level, s.message.clone())
    }

    #[test]
    fn what_is_wrong_is_said_and_graded() {
        let inputs = [
            InputReport { topic: "/cam".into(), vital: true, silent: true, ..Default::default() },
            InputReport { topic: "/odom".into(), vital: true, ..Default::default() },
        ];
        let before = Status { steps: 5, ..Status::default() };
        let mut now = Status { steps: 9, superseded: 3, hop_sec: 0.3, ..before.clone() };
        now.drops.add(DropReason::Overflow, 4);
        let outputs = [("~/output/flow".to_string(), 2), ("/tf".to_string(), 0)];
        let report = |inputs| Report {
            node: "/storm",
            inputs,
            outputs: &outputs,
            status: Some((&now, &before)),
            map: true,
            ..Report::default()
        };
        let statuses = report(&inputs).statuses();
        assert_eq!(level_of(&statuses, "inputs"), (ERROR, "stopped: /cam".into()));
        let (level, message) = level_of(&statuses, "pipeline");
        assert!(level == WARN && message.contains("0.30 s"), "{message}");
        let (level, message) = level_of(&statuses, "losses");
        assert!(level == WARN && message.contains("4 images") && message.contains("overflow"), "{message}");
        assert_eq!(level_of(&report(&inputs[1..]).statuses(), "inputs").0, OK);
        let heard = level_of(&statuses, "outputs");
        assert!(heard.0 == OK && heard.1.starts_with("1 of 2 topics"), "{heard:?}");
        let waiting = Report { waiting: "no pose on /odom", ..Report::default() }.statuses();
        assert_eq!((waiting.len(), waiting[0].level), (1, WARN));
    }
}
