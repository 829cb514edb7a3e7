"""Other ways to choose grasps, for comparison: functions `NAME(scene, gripper, seed) -> GraspSet`, best grasp first."""
