//! Protobuf schemas: of a message from the layout that its run wrote down, and of the recorder's own
//! messages. It encodes nothing; [`crate::codec`] does, by the same checked layout.
//!
//! Field numbers are positions in the layout, from 1; a `reserved` field keeps its number and is
//! left out. A changed layout has a new version in its message's name, so numbers never change
//! their meaning under one name.

use std::collections::BTreeSet;

use hil_rundir::layout;
use hil_rundir::layout::LayoutFault;
use hil_rundir::manifest::{FieldDescription, KindDescription};
use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{
    DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet,
    OneofDescriptorProto,
};

/// What a channel's messages look like to a reader.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Schema {
    /// Full name of the message.
    pub(crate) name: String,
    /// Its file descriptor set.
    pub(crate) data: Vec<u8>,
}

/// The schema of the message called `message`, of `size_bytes` and with these fields.
///
/// # Errors
/// When the fields do not describe exactly that many bytes.
pub(crate) fn of_layout(
    message: &str,
    fields: &[FieldDescription],
    size_bytes: usize,
) -> Result<Schema, LayoutFault> {
    layout::check(fields, size_bytes)?;
    // `hil.EgmCommand.v1` is `v1` of the package `hil.EgmCommand`.
    let full = message
        .split('.')
        .map(identifier)
        .collect::<Vec<_>>()
        .join(".");
    let (package, name) = full.rsplit_once('.').unwrap_or(("", full.as_str()));
    let proto = record(name, &format!(".{full}"), fields);
    Ok(file(package, &full, proto))
}

/// The schema of the bytes of a message whose fields nobody stated: protobuf's own wrapper.
pub(crate) fn opaque() -> Schema {
    let fields = vec![own_field("value", 1, Type::Bytes)];
    let proto = DescriptorProto {
        name: Some("BytesValue".to_owned()),
        field: fields,
        ..DescriptorProto::default()
    };
    file("google.protobuf", "google.protobuf.BytesValue", proto)
}

/// One of the recorder's own messages, `hil.<name>`: its fields with their kinds and numbers, from which
/// protobuf's form and the schema are made.
macro_rules! own_message {
    (@type optional $kind:ident) => { Option<$crate::schema::own_message!(@type $kind)> };
    (@type uint32) => { u32 };
    (@type uint64) => { u64 };
    (@type int64) => { i64 };
    (@type double) => { f64 };
    (@type bool) => { bool };
    (@type string) => { String };
    (
        $(#[$meta:meta])*
        pub(crate) struct $name:ident as $message:literal {
            $($(#[$field_meta:meta])* $field:ident: $($kind:ident)+ = $number:tt,)+
        }
    ) => {
        $(#[$meta])*
        #[derive(Clone, PartialEq, prost::Message)]
        pub(crate) struct $name {
            $(
                $(#[$field_meta])*
                #[prost($($kind),+, tag = $number)]
                pub(crate) $field: $crate::schema::own_message!(@type $($kind)+),
            )+
        }

        impl $name {
            /// Its schema.
            pub(crate) fn schema() -> $crate::schema::Schema {
                $crate::schema::own($message, &[
                    $([stringify!($field), stringify!($($kind)+)]),+
                ])
            }
        }
    };
}
pub(crate) use own_message;

/// The schema of one of the recorder's own messages, `hil.<name>`, whose fields are `[name, kind]`; numbers
/// are positions from 1.
pub(crate) fn own(name: &str, fields: &[[&str; 2]]) -> Schema {
    let mut proto = DescriptorProto {
        name: Some("v1".to_owned()),
        ..DescriptorProto::default()
    };
    for ([name, kind], number) in fields.iter().zip(1..) {
        let optional = kind.strip_prefix("optional ");
        let kind = optional.unwrap_or(kind).to_uppercase();
        let kind = Type::from_str_name(&format!("TYPE_{kind}"));
        let mut field = own_field(
            name,
            number,
            kind.expect("the macro takes protobuf's kinds"),
        );
        if optional.is_some() {
            // What `optional` of proto3 compiles to: a choice of one.
            field.proto3_optional = Some(true);
            field.oneof_index = i32::try_from(proto.oneof_decl.len()).ok();
            proto.oneof_decl.push(OneofDescriptorProto {
                name: Some(format!("_{name}")),
                options: None,
            });
        }
        proto.field.push(field);
    }
    let package = format!("hil.{name}");
    file(&package, &format!("{package}.v1"), proto)
}

fn own_field(name: &str, number: i32, kind: Type) -> FieldDescriptorProto {
    FieldDescriptorProto {
        name: Some(name.to_owned()),
        number: Some(number),
        label: Some(Label::Optional.into()),
        r#type: Some(kind.into()),
        json_name: Some(name.to_owned()),
        ..FieldDescriptorProto::default()
    }
}

fn file(package: &str, full: &str, message: DescriptorProto) -> Schema {
    let file = FileDescriptorProto {
        name: Some(format!("{}.proto", full.replace('.', "/"))),
        package: (!package.is_empty()).then(|| package.to_owned()),
        message_type: vec![message],
        syntax: Some("proto3".to_owned()),
        ..FileDescriptorProto::default()
    };
    Schema {
        name: full.to_owned(),
        data: FileDescriptorSet { file: vec![file] }.encode_to_vec(),
    }
}

/// The structure `name`, which readers find under `path`.
fn record(name: &str, path: &str, fields: &[FieldDescription]) -> DescriptorProto {
    let mut proto = DescriptorProto {
        name: Some(name.to_owned()),
        ..DescriptorProto::default()
    };
    let mut taken = BTreeSet::new();
    let mut nested: Vec<(&KindDescription, String)> = Vec::new();
    for (field, number) in fields.iter().zip(1..) {
        if field.is_reserved() {
            continue;
        }
        let field_name = unique(identifier(&field.name), &mut taken);
        let mut described = own_field(&field_name, number, scalar_type(&field.kind));
        if field.count.is_some() {
            described.label = Some(Label::Repeated.into());
        }
        if let KindDescription::Record { name, fields } = &field.kind {
            let known = nested.iter().find(|(kind, _)| **kind == field.kind);
            let inner = known.map(|(_, inner)| inner.clone());
            let inner = inner.unwrap_or_else(|| {
                // Types and fields share one room of names.
                let inner = unique(identifier(name), &mut taken);
                let path = format!("{path}.{inner}");
                proto.nested_type.push(record(&inner, &path, fields));
                nested.push((&field.kind, inner.clone()));
                inner
            });
            described.type_name = Some(format!("{path}.{inner}"));
        }
        proto.field.push(described);
    }
    proto
}

fn scalar_type(kind: &KindDescription) -> Type {
    match kind {
        KindDescription::U8 | KindDescription::U16 | KindDescription::U32 => Type::Uint32,
        KindDescription::U64 => Type::Uint64,
        KindDescription::I8 | KindDescription::I16 | KindDescription::I32 => Type::Sint32,
        KindDescription::I64 => Type::Sint64,
        KindDescription::F32 => Type::Float,
        KindDescription::F64 => Type::Double,
        KindDescription::Record { .. } => Type::Message,
    }
}

/// `text` as protobuf allows names: letters, digits and `_`, no digit first. What it does not allow becomes
/// `_`.
fn identifier(text: &str) -> String {
    let text = text.strip_prefix("r#").unwrap_or(text);
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let name: String = text
        .chars()
        .map(|c| if is_allowed(c) { c } else { '_' })
        .collect();
    if name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') {
        name
    } else {
        format!("_{name}")
    }
}

/// `name`, or `name` with as many `_` behind as make it new.
fn unique(mut name: String, taken: &mut BTreeSet<String>) -> String {
    while !taken.insert(name.clone()) {
        name.push('_');
    }
    name
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_arm::egm::messages::EgmFeedback;
    use hil_core::message::Message;
    use hil_fleet::messages::State;
    use hil_rundir::manifest::describe_fields;

    fn descriptor(schema: &Schema) -> DescriptorProto {
        let set = FileDescriptorSet::decode(schema.data.as_slice()).unwrap();
        set.file[0].message_type[0].clone()
    }

    #[test]
    fn numbers_are_positions_and_reserved_fields_are_left_out() {
        let fields = describe_fields(State::FIELDS);
        let schema = of_layout(State::NAME, &fields, size_of::<State>()).unwrap();
        assert_eq!(schema.name, "hil.FleetState.v2");
        let proto = descriptor(&schema);
        let last = proto.field.last().unwrap();
        assert_eq!((last.name(), last.number()), ("flags", 15));
        assert_eq!(proto.field[0].type_name(), ".hil.FleetState.v2.Header");
        assert!(proto.field.iter().all(|field| field.name() != "reserved"));
    }

    #[test]
    fn a_layout_that_does_not_cover_its_message_is_refused() {
        let fields = describe_fields(EgmFeedback::FIELDS);
        let of = |fields: &[FieldDescription], size| of_layout("a.B.v1", fields, size);
        let end = LayoutFault::End {
            found: 216,
            expected: 217,
        };
        assert_eq!(of(&fields, 217), Err(end));
        assert!(matches!(
            of(&fields[1..], 208),
            Err(LayoutFault::Gap { expected: 0, .. })
        ));
        assert_eq!(of(&[], 8), Err(LayoutFault::Unknown));
        let mut huge = fields.clone();
        huge[0].count = Some(usize::MAX);
        assert_eq!(of(&huge, 8), Err(LayoutFault::TooLarge));
    }

    #[test]
    fn any_name_becomes_one_that_protobuf_allows() {
        let field = |name: &str| FieldDescription {
            name: name.to_owned(),
            kind: KindDescription::U8,
            count: None,
            offset_bytes: 0,
        };
        let mut fields = vec![field("r#type"), field("größe m"), field("gr__e_m")];
        for (field, offset) in fields.iter_mut().zip(0..) {
            field.offset_bytes = offset;
        }
        let schema = of_layout("My robot/arm 2", &fields, 3).unwrap();
        assert_eq!(schema.name, "My_robot_arm_2");
        let names: Vec<String> = descriptor(&schema)
            .field
            .iter()
            .map(|field| field.name().to_owned())
            .collect();
        assert_eq!(names, ["type", "gr__e_m", "gr__e_m_"]);
        assert_eq!(of_layout("", &fields, 3).unwrap().name, "_");
    }
}
