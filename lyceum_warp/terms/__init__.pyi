from lyceum_warp.terms.action_changes import (
    action_acceleration_l2 as action_acceleration_l2,
    action_rate_l2 as action_rate_l2,
)
from lyceum_warp.terms.base_motion import (
    alive as alive,
    angular_velocity as angular_velocity,
    base_height as base_height,
    base_height_l2 as base_height_l2,
    fell_over as fell_over,
    gravity as gravity,
    heading as heading,
    linear_velocity as linear_velocity,
    orientation as orientation,
    roll_pitch_rate_l2 as roll_pitch_rate_l2,
    tilt_l2 as tilt_l2,
    too_low as too_low,
    track_angular_velocity as track_angular_velocity,
    track_linear_velocity as track_linear_velocity,
    upright as upright,
    velocity_error as velocity_error,
    vertical_velocity_l2 as vertical_velocity_l2,
    yaw_rate_error as yaw_rate_error,
)
from lyceum_warp.terms.draws import (
    chosen as chosen,
    draw_friction as draw_friction,
    draw_row as draw_row,
    log_uniform as log_uniform,
    scale_elements as scale_elements,
    scale_gains as scale_gains,
    scale_mass as scale_mass,
    shift_center_of_mass as shift_center_of_mass,
    uniform_int as uniform_int,
)
from lyceum_warp.terms.feet import (
    clearance as clearance,
    follow_swing as follow_swing,
    foot_clearance as foot_clearance,
    foot_slip as foot_slip,
    foot_swing_height as foot_swing_height,
    ground_speed as ground_speed,
    landed as landed,
    run_clocks as run_clocks,
    sensor_vector as sensor_vector,
    soft_landing as soft_landing,
)
from lyceum_warp.terms.histories import (
    delayed_action as delayed_action,
    history_length as history_length,
    push_history as push_history,
    put_history as put_history,
    read_history as read_history,
)
from lyceum_warp.terms.joints import (
    absolute_power as absolute_power,
    joint_acceleration_l2 as joint_acceleration_l2,
    joint_limits as joint_limits,
    joint_velocity_l2 as joint_velocity_l2,
    pose as pose,
    pose_l2 as pose_l2,
    posture as posture,
    power as power,
    sum_squares_at as sum_squares_at,
    torque_l2 as torque_l2,
)
from lyceum_warp.terms.motors import (
    dc_motor_torque as dc_motor_torque,
    servo_torque as servo_torque,
)
from lyceum_warp.terms.observations import (
    add_normal_noise as add_normal_noise,
    add_uniform_noise as add_uniform_noise,
    gather as gather,
    gather_positions as gather_positions,
)
from lyceum_warp.terms.pushes import (
    push as push,
)
from lyceum_warp.terms.velocity_commands import (
    active as active,
    command_size as command_size,
    draw_flag as draw_flag,
    draw_forward_only as draw_forward_only,
    draw_heading as draw_heading,
    draw_timer as draw_timer,
    draw_velocity as draw_velocity,
    heading_yaw_rate as heading_yaw_rate,
    is_due as is_due,
    run_timer as run_timer,
    velocity_command as velocity_command,
)

ARGUMENTS: dict[str, str]
