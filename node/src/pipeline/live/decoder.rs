//! The decode thread: messages to events.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use tracing::warn;

use super::inbox::{Inbox, Taken};
use super::worker::{LOGGED, LiveInput, Message, PATIENCE};
use crate::source::translate::{Role, translate};
use crate::source::{Event, Rig};

/// What the thread owns.
pub(super) struct Decoder {
    pub messages: Arc<Inbox<Message>>,
    pub events: Arc<Inbox<Event>>,
    pub rig: Arc<Rig>,
    pub inputs: Vec<LiveInput>,
    /// Time of the newest picture, milliseconds.
    pub ms: Arc<Mutex<f64>>,
}

impl Decoder {
    /// Runs until the messages end.
    pub fn run(self) {
        let others = self.rig.cameras.len();
        let mut losses = vec![0u64; self.inputs.len()];
        loop {
            let messages = match self.messages.take(1, PATIENCE) {
                Taken::Some(messages) => messages,
                Taken::Nothing => continue,
                Taken::Closed => break,
            };
            for Message { input, data, received_ns } in messages {
                let Some(LiveInput { topic, role }) = self.inputs.get(input) else { continue };
                let start = Instant::now();
                translate(&self.rig, role, topic, &data, received_ns, &mut |event| {
                    let stream = match &event {
                        Event::Image { camera, .. } => *camera,
                        _ => others,
                    };
                    if let Event::Lost { detail, .. } = &event {
                        losses[input] += 1;
                        if losses[input] <= LOGGED {
                            warn!("{detail}");
                        }
                    }
                    self.events.push(stream, event);
                });
                if matches!(role, Role::Image { .. }) {
                    let ms = start.elapsed().as_secs_f64() * 1e3;
                    *self.ms.lock().unwrap_or_else(PoisonError::into_inner) = ms;
                }
            }
        }
        self.events.close();
    }
}
