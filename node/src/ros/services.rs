//! `~/reset`, `~/pause`, `~/save_map`, `~/load_map`. Requests are answered by the step thread, between two steps.

use std::cell::RefCell;
use std::rc::Rc;

use anyhow::Result;
use futures::executor::LocalSpawner;
use futures::stream::StreamExt;
use futures::task::LocalSpawnExt;
use r2r::std_srvs::srv::{SetBool, Trigger};
use r2r::{Node, QosProfile, ServiceRequest};
use tracing::{info, warn};

use crate::pipeline::live::{Command, Reply};

/// Commands that came in and were not handed on yet.
pub type Requests = Rc<RefCell<Vec<Command>>>;

/// Makes the command that answers so.
type MakeCommand = fn(Reply) -> Command;

/// Offers the services; commands appear in `requests`.
///
/// # Errors
/// What ROS refuses.
pub fn offer(node: &mut Node, spawner: &LocalSpawner, requests: &Requests) -> Result<()> {
    let triggers: [(&'static str, MakeCommand); 3] =
        [("reset", Command::Reset), ("save_map", Command::SaveMap), ("load_map", Command::LoadMap)];
    for (name, command) in triggers {
        let stream = node.create_service::<Trigger::Service>(&format!("~/{name}"), QosProfile::services_default())?;
        let requests = requests.clone();
        spawner.spawn_local(stream.for_each(move |request| {
            requests.borrow_mut().push(command(answer(name, request)));
            futures::future::ready(())
        }))?;
    }
    let stream = node.create_service::<SetBool::Service>("~/pause", QosProfile::services_default())?;
    let requests = requests.clone();
    spawner.spawn_local(stream.for_each(move |request: ServiceRequest<SetBool::Service>| {
        let paused = request.message.data;
        let reply: Reply = Box::new(move |outcome| {
            let (success, message) = told("pause", outcome);
            said("pause", request.respond(SetBool::Response { success, message }));
        });
        requests.borrow_mut().push(Command::Pause(paused, reply));
        futures::future::ready(())
    }))?;
    Ok(())
}

fn answer(name: &'static str, request: ServiceRequest<Trigger::Service>) -> Reply {
    Box::new(move |outcome| {
        let (success, message) = told(name, outcome);
        said(name, request.respond(Trigger::Response { success, message }));
    })
}

fn told(name: &str, outcome: std::result::Result<String, String>) -> (bool, String) {
    match outcome {
        Ok(message) => {
            info!("{name}: {message}");
            (true, message)
        }
        Err(message) => {
            warn!("{name} failed: {message}");
            (false, message)
        }
    }
}

fn said(name: &str, sent: r2r::Result<()>) {
    if let Err(e) = sent {
        warn!("{name}: the answer could not be sent: {e}");
    }
}

/// Answers a command that cannot be carried out now.
pub fn refuse(command: Command, why: &str) {
    match command {
        Command::Reset(reply) | Command::SaveMap(reply) | Command::LoadMap(reply) | Command::Pause(_, reply) => {
            reply(Err(why.into()));
        }
        Command::Cameras(_) | Command::Configure(_) => {}
    }
}
