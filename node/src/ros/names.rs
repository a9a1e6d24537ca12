//! Names as ROS resolves them: private and relative names made absolute, then the command line's remapping rules.
//!
//! rcl does this for what a node opens. Asking the graph who publishes a topic needs the final name, which r2r does not
//! tell.

/// The node's name, namespace and remapping rules.
#[derive(Debug, Clone, PartialEq)]
pub struct Names {
    /// `/namespace/name`.
    pub node: String,
    namespace: String,
    /// From and to, both absolute.
    rules: Vec<(String, String)>,
}

impl Names {
    /// For the node `name` in `namespace`, with the rules in the program's arguments.
    pub fn new(name: &str, namespace: &str, args: impl IntoIterator<Item = String>) -> Self {
        let namespace = format!("/{}", namespace.trim_matches('/'));
        let node = join(&namespace, name);
        let mut names = Self { node, namespace, rules: Vec::new() };
        for rule in remap_rules(args) {
            let Some((from, to)) = rule.split_once(":=") else { continue };
            // `node:from:=to` is for that node alone.
            let from = match from.split_once(':') {
                Some((node, _)) if node != name => continue,
                Some((_, from)) => from,
                None => from,
            };
            if !from.starts_with("__") {
                let rule = (names.absolute(from), names.absolute(to));
                names.rules.push(rule);
            }
        }
        names
    }

    fn absolute(&self, name: &str) -> String {
        match name.strip_prefix('~') {
            Some(own) => join(&self.node, own.trim_start_matches('/')),
            None if name.starts_with('/') => name.into(),
            None => join(&self.namespace, name),
        }
    }

    /// The name a topic ends up with.
    pub fn resolve(&self, name: &str) -> String {
        let name = self.absolute(name);
        let rule = self.rules.iter().find(|(from, _)| *from == name);
        rule.map_or(name, |(_, to)| to.clone())
    }
}

fn join(parent: &str, child: &str) -> String {
    format!("{}/{child}", parent.trim_end_matches('/'))
}

/// The values of `-r` and `--remap` between `--ros-args` and `--`.
fn remap_rules(args: impl IntoIterator<Item = String>) -> Vec<String> {
    let (mut inside, mut rules) = (false, Vec::new());
    let mut args = args.into_iter();
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--ros-args" => inside = true,
            "--" => inside = false,
            "-r" | "--remap" if inside => rules.extend(args.next()),
            _ => {}
        }
    }
    rules
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(args: &str) -> Names {
        Names::new("storm", "/car", args.split_whitespace().map(str::to_owned))
    }

    #[test]
    fn private_relative_and_absolute_names() {
        let n = names("storm node");
        assert_eq!(n.resolve("~/output/flow"), "/car/storm/output/flow");
        assert_eq!(n.resolve("odom"), "/car/odom");
        assert_eq!(n.resolve("/odom"), "/odom");
        assert_eq!(Names::new("storm", "/", []).resolve("~/a"), "/storm/a");
    }

    #[test]
    fn rules_hold_inside_ros_args_alone() {
        let n =
            names("-r a:=b --ros-args -r ~/input/pose:=/odom --remap __node:=x other:a:=c -r storm:a:=d -- -r e:=f");
        assert_eq!(n.resolve("~/input/pose"), "/odom");
        assert_eq!(n.resolve("a"), "/car/d");
        assert_eq!(n.resolve("e"), "/car/e");
        assert_eq!(names("--ros-args -r other:a:=c").resolve("a"), "/car/a");
    }
}
