"""Table of the facts about firmware that is newer than manual B, and about newer frames of manual A: section and key |
reaction of imud | its code, or `left:` and a reason | its tests.

Source: public SDKs and newer manuals of both vendors, and a note of a third party (register 0x9D). Sections: 1 HI81,
2 HI83, 3 CAN, 4 Modbus, 5 commands, 6 firmware update, 7 Forsense.
"""

# ruff: noqa: E501

from typing import Final

from tests.audit.item import item_of

_INS: Final = "drivers/hipnuc/uart/test_ins.py::"
_FD: Final = "drivers/hipnuc/test_canfd.py::"
_J1939: Final = "drivers/hipnuc/j1939/test_codec.py::"
_ON_CAN: Final = "drivers/hipnuc/test_moves_and_settings_on_can.py::"
_MODBUS: Final = "drivers/hipnuc/modbus/test_codec.py::"
_REGISTERS: Final = "drivers/hipnuc/modbus/test_commands.py::"
_FIRMWARE: Final = "drivers/hipnuc/uart/test_firmware.py::"
_UPDATE: Final = "drivers/hipnuc/test_firmware_update.py::"
_ROWS: Final = f"""\
C 1 layout | tag 0x81, 104 bytes, status as in HI91, INS status in bits 16 to 23 of `status` | drivers.hipnuc.uart.ins:HI81 | {_INS}test_hand_made_hi81
C 1 time | GPS week and time of week: device time; date and time: `gnss_utc_ns` | drivers.hipnuc.uart.ins:decode_hi81 | {_INS}test_hand_made_hi81
C 1 vectors | angular rate, acceleration, magnetic field, velocity | drivers.hipnuc.uart.ins:decode_hi81 | {_INS}test_hand_made_hi81 {_INS}test_filler_and_impossible_values_of_hi81
C 1 angles | roll, pitch, clockwise heading, quaternion | drivers.hipnuc.uart.ins:decode_hi81 | {_INS}test_heading_becomes_counter_clockwise
C 1 position | longitude, latitude, height, quality, satellites | drivers.hipnuc.uart.ins:decode_hi81 | {_INS}test_hand_made_hi81
C 1 other fields | PDOP, HDOP, odometer, heading quality, age, geoid, antenna, acceleration ENU | left: no output of imud needs them (docstring of drivers.hipnuc.uart.ins)
C 2 layout | tag 0x83, status, INS status, bitmap, fields in ascending order | drivers.hipnuc.uart.ins:HI83_HEAD | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 length | a length that does not match the bitmap makes the frame bad | drivers.hipnuc.uart.ins:hi83_bytes | {_INS}test_internal_and_unknown_bits_are_rejected
C 2 bits 0 and 10 | acceleration; heave, without surge and sway | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 1 and 11 | angular rate; frequencies of heave, not published | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 2 and 12 | magnetic field; velocity ENU | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 3 and 13 | roll, pitch, yaw; acceleration ENU, not published | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 4 and 14 | quaternion; longitude, latitude, height | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 5 and 15 | system time; quality and satellites | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 6 and 16 | UTC; odometer, not published | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 7 and 17 | pressure; geoid separation, not published | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 8 and 18 | temperature; age of corrections, not published | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 9 and 19 | inclination and node identifier, not published | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 2 bits 25 to 29 | internal: the frame is rejected and counted | drivers.hipnuc.uart.ins:KNOWN_BITS | {_INS}test_internal_and_unknown_bits_are_rejected
C 2 bits 30 and 31 | position and velocity of the receiver alone, not published | drivers.hipnuc.uart.ins:FIELDS | {_INS}test_each_field_of_hi83_alone_and_at_its_place
C 3 CAN FD | frames of up to 64 bytes on SocketCAN, python-can and in candump logs | links.socketcan:open_raw | links/test_socketcan.py::test_a_read_is_bounded_and_frames_come_with_the_time_of_their_arrival links/test_python_can.py::test_frames_pass_the_filters_in_the_loops_thread_and_commands_go_out formats/test_can.py::test_lines_of_candump lab/test_hipnuc_can.py::test_can_fd_samples_of_a_found_device_and_a_change
C 3 FF5B fields | the fields of HI83 with the bits 0 to 6 and 8, padding | drivers.hipnuc.canfd:HipnucCanfdCodec | {_FD}test_the_newer_frame_by_hand {_FD}test_every_bitmap_has_shortest_length_or_64_bytes
C 3 FF5B bitmap | other bits, or another length, make the frame bad | drivers.hipnuc.canfd:KNOWN_BITS | {_FD}test_a_bitmap_that_does_not_match_makes_a_frame_bad
C 3 FF5B sequence | proves losses | drivers.hipnuc.canfd:HipnucCanfdCodec | {_FD}test_the_sequence_number_proves_losses_and_copies_are_ignored sampling/test_path.py::test_a_loss_that_the_codec_counts_is_not_counted_by_the_clock
C 3 FF5A | 64 bytes of older firmware | drivers.hipnuc.canfd:OLD | {_FD}test_the_older_frame_by_hand
C 3 FF10 | latitude first, then longitude, 1e-7 degrees | drivers.hipnuc.j1939.codec:PLACE | {_J1939}test_position_and_velocity_by_hand
C 3 FF14 | height; geoid separation and age are not published | drivers.hipnuc.j1939.codec:HEIGHT_LAYOUT | {_J1939}test_position_and_velocity_by_hand
C 3 FF18 | quality and satellites of the position | drivers.hipnuc.j1939.codec:GNSS_LAYOUT | {_J1939}test_position_and_velocity_by_hand
C 3 FF26 | velocity ENU; the ground speed follows from it | drivers.hipnuc.j1939.codec:VELOCITY_LAYOUT | {_J1939}test_position_and_velocity_by_hand
C 3 FF2F | a zero date is the uptime: no UTC, and no loss at 24 h | drivers.hipnuc.j1939.codec:utc_of | {_J1939}test_a_time_without_a_date_is_the_uptime_and_neither_utc_nor_a_loss
C 3 interval 0 | switches a message off, and is read back | drivers.hipnuc.j1939.commands:NEVER_MS | {_ON_CAN}test_a_saved_setting_is_read_after_a_restart {_ON_CAN}test_j1939_values_that_do_not_go_together_are_refused
C 3 register 0x9D | setting `output_enabled` | drivers.hipnuc.j1939.commands:set_output | {_ON_CAN}test_a_saved_setting_is_read_after_a_restart drivers/hipnuc/j1939/test_commands.py::test_all_that_can_be_read
C 4 heave | 0x4E to 0x50: `heave_m`; surge and sway by the command `read` | drivers.hipnuc.modbus.codec:READ_LONG_BLOCK | {_MODBUS}test_heave_extends_the_block_by_hand
C 4 frequencies | 0x51 to 0x53, by the command `read` | drivers.hipnuc.modbus.registers:HEAVE_HZ_PER_LSB | {_MODBUS}test_heave_extends_the_block_by_hand {_REGISTERS}test_table_of_registers
C 4 addresses | 1 to 247; older firmware rejects addresses above 128 | drivers.hipnuc.modbus.registers:ID_MAX | {_REGISTERS}test_addresses_that_are_taken_not_accepted_or_lost
C 4 save | without an effect in the newest firmware: never verified, and the flash stays unknown | drivers.hipnuc.modbus.commands:save | {_REGISTERS}test_settings_are_read_back_and_saved_only_on_request device/test_settings.py::test_a_save_that_may_have_no_effect_proves_nothing_about_the_flash
C 5 COORD | selects the axes, also lower case, negative or without a value | drivers.hipnuc.uart.firmware:SETTINGS | {_FIRMWARE}test_settings_are_written_read_back_saved_and_kept drivers/hipnuc/uart/test_settings.py::test_coordinates_select_axes_and_the_angles_of_the_alarm
C 5 URFR digits | directions of the physical axes: `mounting` | drivers.hipnuc.uart.firmware:matrix_of_digits | {_FIRMWARE}test_digits_are_the_directions_of_the_physical_axes {_FIRMWARE}test_impossible_digits_are_rejected_before_a_write
C 5 ATT MODE | 0, 1, 4, 5, 7: `mode` | drivers.hipnuc.common:AttitudeMode | {_FIRMWARE}test_settings_are_written_read_back_saved_and_kept
C 5 MCAL START | calibration with progress, also with 2D | drivers.hipnuc.uart.firmware:start_calibration | {_FIRMWARE}test_a_calibration_by_command_reports_its_progress device/test_calibration.py::test_magnetometer_by_a_command_with_the_progress_of_the_device
C 5 MCAL STAT | state and percent | drivers.hipnuc.uart.firmware:read_calibration | {_FIRMWARE}test_states_of_a_calibration
C 5 several ports | `LOG COMn`, `SERIALCONFIG COMn`: `port_output`, `port_baud` | drivers.hipnuc.uart.firmware:port_bauds | {_FIRMWARE}test_reports_of_several_ports_and_their_text {_FIRMWARE}test_the_baud_rate_of_the_port_of_imud_is_restored
C 5 USRCONFIG | lines NAME=VALUE | drivers.hipnuc.uart.replies:parse_report | {_FIRMWARE}test_settings_are_written_read_back_saved_and_kept
C 5 NMEA sentences | between the lines of a reply: ignored frames | drivers.hipnuc.uart.replies:LineFinder | drivers/hipnuc/uart/test_codec.py::test_nmea_sentences_between_the_lines_of_a_reply_are_ignored_frames
C 5 older codes | ZARU, ABW, ARG, GBW, GRG, INC_FMT | drivers.hipnuc.uart.firmware:OlderCode | {_FIRMWARE}test_settings_are_written_read_back_saved_and_kept
C 5 ATT RST 1 and 4 | verb of older firmware | drivers.hipnuc.uart.firmware:reset_attitude | {_FIRMWARE}test_verbs_of_older_firmware_and_ins_models
C 5 INS models | SETBASELINE, INSCONFIG, GGA, RMC, SXT, HI81 | drivers.hipnuc.uart.firmware:ins_config | {_FIRMWARE}test_settings_are_written_read_back_saved_and_kept {_FIRMWARE}test_verbs_of_older_firmware_and_ins_models
C 6 AT+RST | starts the boot loader of a serial device | drivers.hipnuc.uart.kboot:RESTART | {_UPDATE}test_update_writes_and_starts_the_image
C 6 kboot packets | ping, length, CRC, acknowledgement of each packet | drivers.hipnuc.uart.kboot:packet | {_UPDATE}test_golden_packets {_UPDATE}test_damaged_packet_counts_as_bad_and_the_next_reply_is_found
C 6 kboot commands | get-property, erase-region, write-memory, reset | drivers.hipnuc.uart.kboot:update | {_UPDATE}test_update_writes_and_starts_the_image {_UPDATE}test_image_outside_the_flash_erases_nothing
C 6 Intel HEX | read by the library `intelhex` and checked | cli.firmware:parse_image | cli/test_firmware.py::test_gaps_contain_the_value_of_erased_flash cli/test_firmware.py::test_damaged_and_foreign_files_are_refused
C 6 CAN | SDO object 0x1F51: sub-indices 5, 6, 1, 9 | drivers.hipnuc.canopen.firmware:PROGRAM | {_UPDATE}test_update_writes_and_starts_the_image {_UPDATE}test_second_update_succeeds_after_a_fault_at_any_step
C 6 vendor's tool | updates the simulated boot loaders | sim.hipnuc.boot_loader:KbootLoader | drivers/hipnuc/test_firmware_vendor_tool.py::test_vendor_library_updates_the_simulated_node drivers/hipnuc/test_firmware_vendor_tool.py::test_vendor_tool_updates_the_simulated_device
C 7 frame 0x0666 | raw data: decoded with a layout from the configuration; no source states the layout | drivers.imu61x.uart.raw:RawFrame | drivers/imu61x/uart/test_raw.py::test_golden_frames_of_each_type drivers/imu61x/uart/test_codec.py::test_frames_of_other_kinds_and_lengths
C 7 frame 0x0166 | navigation: named and counted, not decoded | drivers.imu61x.uart.codec:frame_name | drivers/imu61x/uart/test_codec.py::test_frames_of_other_kinds_and_lengths
C 7 AHRS of 56 bytes | magnetic field after the temperature | drivers.imu61x.uart.codec:MAG | drivers/imu61x/uart/test_codec.py::test_frame_of_56_bytes_contains_the_magnetic_field sim/imu61x/test_uart.py::test_ahrs_frames_of_newer_models_contain_the_true_magnetic_field
"""


ITEMS: Final = [item_of(row) for row in _ROWS.splitlines()]
