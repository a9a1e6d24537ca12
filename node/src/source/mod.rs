//! Where images and poses come from. A source turns its own kind of message into [`Event`]s and nothing more; live
//! topics and recorded bags give the same events, so everything behind them is one program.

mod ahead;
pub mod bag;
pub mod cameras;
pub mod event;
mod first;
mod first_images;
pub mod frames;
pub mod masks;
pub mod mount;
pub mod rectified;
pub mod rig;
pub mod survey;
pub mod topics;
pub mod translate;
pub mod world;

pub use event::{Event, Frame, Truth};
pub use first_images::look_at;
pub use rig::{Rig, RigError};
pub use topics::{TopicError, TopicPlan};
