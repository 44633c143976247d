//! A tree of joints and the poses its channel values put them in. It does not read or write
//! motion files: see [`super::bvh`].

use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// What one channel value of a joint means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channel {
    /// Position along axis 0 (x), 1 (y) or 2 (z), in the file's length unit. It replaces that
    /// part of the joint's offset, which is how capture systems export displacements.
    Position(usize),
    /// Rotation about axis 0, 1 or 2 in degrees, applied in the order the channels are listed.
    Rotation(usize),
}

impl Channel {
    /// The name a motion file gives it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Position(0) => "Xposition",
            Self::Position(1) => "Yposition",
            Self::Position(_) => "Zposition",
            Self::Rotation(0) => "Xrotation",
            Self::Rotation(1) => "Yrotation",
            Self::Rotation(_) => "Zrotation",
        }
    }

    /// The channel called `name`, whatever its case.
    pub fn from_name(name: &str) -> Option<Self> {
        [0, 1, 2]
            .into_iter()
            .flat_map(|axis| [Self::Position(axis), Self::Rotation(axis)])
            .find(|channel| channel.name().eq_ignore_ascii_case(name))
    }
}

/// One joint.
#[derive(Debug, Clone, PartialEq)]
pub struct SkeletonJoint {
    /// Name, e.g. `RightHand`.
    pub name: String,
    /// Index of the parent, always below the joint's own; `None` for the root.
    pub parent: Option<usize>,
    /// Rest position in the parent's frame, in the file's length unit.
    pub offset: Vector3<f64>,
    /// Meaning of the joint's channel values, in file order.
    pub channels: Vec<Channel>,
    /// Where the joint's channel values begin within a frame.
    pub first_channel: usize,
}

/// A tree of joints, parents first.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Skeleton {
    joints: Vec<SkeletonJoint>,
    channel_count: usize,
}

impl Skeleton {
    /// Appends a joint and returns its index.
    ///
    /// # Panics
    /// When `parent` is not the index of an earlier joint.
    pub fn push(
        &mut self,
        name: &str,
        parent: Option<usize>,
        offset: [f64; 3],
        channels: &[Channel],
    ) -> usize {
        let index = self.joints.len();
        assert!(
            parent.is_none_or(|parent| parent < index),
            "the parent of joint {index} comes before it"
        );
        self.joints.push(SkeletonJoint {
            name: name.to_owned(),
            parent,
            offset: offset.into(),
            channels: channels.to_vec(),
            first_channel: self.channel_count,
        });
        self.channel_count += channels.len();
        index
    }

    /// The joints, parents first.
    pub fn joints(&self) -> &[SkeletonJoint] {
        &self.joints
    }

    /// Values per frame.
    pub fn channel_count(&self) -> usize {
        self.channel_count
    }

    /// The first joint that `is_it` says yes to by its name.
    pub fn find(&self, is_it: impl Fn(&str) -> bool) -> Option<usize> {
        self.joints.iter().position(|joint| is_it(&joint.name))
    }

    /// Pose of joint `index` in the skeleton's world frame, lengths times `unit_m`.
    ///
    /// # Panics
    /// When there is no joint `index` or `values` is not one frame of [`Self::channel_count`].
    pub fn pose(&self, index: usize, values: &[f64], unit_m: f64) -> Isometry3<f64> {
        assert_eq!(values.len(), self.channel_count, "one value per channel");
        let joint = &self.joints[index];
        let mut pose = local_pose(joint, values, unit_m);
        let mut parent = joint.parent;
        while let Some(ancestor) = parent.map(|index| &self.joints[index]) {
            pose = local_pose(ancestor, values, unit_m) * pose;
            parent = ancestor.parent;
        }
        pose
    }
}

fn local_pose(joint: &SkeletonJoint, values: &[f64], unit_m: f64) -> Isometry3<f64> {
    let mut position = joint.offset;
    let mut rotation = UnitQuaternion::identity();
    for (channel, value) in joint.channels.iter().zip(&values[joint.first_channel..]) {
        match *channel {
            Channel::Position(axis) => position[axis] = *value,
            Channel::Rotation(axis) => {
                let axis = Vector3::ith_axis(axis);
                rotation *= UnitQuaternion::from_axis_angle(&axis, value.to_radians());
            }
        }
    }
    Isometry3::from_parts((position * unit_m).into(), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_arm_ends_where_geometry_says() {
        use Channel::{Position, Rotation};
        let mut skeleton = Skeleton::default();
        let root = skeleton.push(
            "Hips",
            None,
            [0.0; 3],
            &[Position(0), Position(1), Rotation(2)],
        );
        let elbow = skeleton.push("Elbow", Some(root), [10.0, 0.0, 0.0], &[Rotation(2)]);
        let hand = skeleton.push("Hand", Some(elbow), [5.0, 0.0, 0.0], &[]);
        // Root at (1, 2), turned left by 90 degrees; elbow turned back by 90 degrees.
        let pose = skeleton.pose(hand, &[1.0, 2.0, 90.0, -90.0], 0.01);
        let expected = Isometry3::translation(0.06, 0.12, 0.0);
        assert!((pose.translation.vector - expected.translation.vector).norm() < 1e-15);
        assert!(pose.rotation.angle_to(&expected.rotation) < 1e-12);
    }

    #[test]
    fn channel_names_are_read_back_in_any_case() {
        for channel in [0, 1, 2].map(Channel::Rotation) {
            let name = channel.name().to_uppercase();
            assert_eq!(Channel::from_name(&name), Some(channel));
        }
        assert_eq!(Channel::from_name("Wrotation"), None);
    }
}
