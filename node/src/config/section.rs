//! The macro a configuration section is written with.

/// One parameter as the documentation shows it.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterDoc {
    /// Dotted name, `section.key`.
    pub name: String,
    /// Default, as YAML.
    pub default: String,
    /// What it does, one line.
    pub description: String,
}

/// Writes a struct whose fields carry their defaults (`name: Type = default`), and its `describe`.
macro_rules! section {
    ($(#[doc = $about:expr])* pub struct $name:ident { $( $(#[doc = $doc:expr])* $field:ident : $ty:ty = $default:expr, )* }) => {
        $(#[doc = $about])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct $name { $( $(#[doc = $doc])* pub $field: $ty, )* }

        impl Default for $name {
            fn default() -> Self {
                Self { $( $field: $default, )* }
            }
        }

        impl $name {
            /// This section's parameters, named `prefix.key`.
            pub fn describe(prefix: &str) -> Vec<$crate::config::ParameterDoc> {
                let defaults = Self::default();
                vec![ $( $crate::config::ParameterDoc {
                    name: format!("{prefix}.{}", stringify!($field)),
                    default: serde_json::to_string(&defaults.$field).unwrap_or_default(),
                    description: concat!($($doc),*).trim().to_string(),
                }, )* ]
            }
        }
    };
}
pub(crate) use section;
