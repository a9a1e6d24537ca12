//! A topic that knows whether anybody listens. Messages are serialised by us, once, and handed over as bytes.

use anyhow::{Context, Result};
use r2r::{Node, PublisherUntyped};

use super::qos::offered;
use crate::cdr::write::EncodeError;
use crate::output::qos::Qos;

/// One output topic; copies are handles of the same.
#[derive(Clone)]
pub struct Topic {
    publisher: PublisherUntyped,
    name: String,
}

impl Topic {
    /// Declares the topic `name` of the type `type_name` (`sensor_msgs/msg/Image`).
    ///
    /// # Errors
    /// A type that was not sourced when the program was built, or a name ROS refuses.
    pub fn new(node: &mut Node, name: &str, type_name: &str, qos: Qos) -> Result<Self> {
        let publisher = node
            .create_publisher_untyped(name, type_name, offered(qos))
            .with_context(|| format!("cannot publish {name} ({type_name})"))?;
        Ok(Self { publisher, name: name.into() })
    }

    /// Its name as it was declared.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Subscriptions outside of this process.
    pub fn listeners(&self) -> usize {
        self.publisher.get_inter_process_subscription_count().unwrap_or(0)
    }

    /// Whether anybody listens.
    pub fn wanted(&self) -> bool {
        self.listeners() > 0
    }

    /// Sends one message.
    ///
    /// # Errors
    /// It cannot be serialised, or the middleware refuses it.
    pub fn send(&self, cdr: std::result::Result<Vec<u8>, EncodeError>) -> Result<()> {
        let cdr = cdr.with_context(|| self.name.clone())?;
        self.publisher.publish_raw(&cdr).with_context(|| format!("{} ({} bytes)", self.name, cdr.len()))
    }
}
