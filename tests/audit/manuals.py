"""Table of the items of both manuals, by section: key | reaction of imud | its code, or `left:` and a reason.

Manual A is "IMU61X Interface Protocol and Instructions", manual B is "IMU配置手冊" V1.5.9.
"""

# ruff: noqa: E501

from typing import Final

from tests.audit.item import item_of

_ROWS: Final = """\
A 1 stream mode | periodic AHRS frames | drivers.imu61x.uart.codec:Imu61xCodec
A 1 command mode | no samples, replies only | drivers.imu61x.uart.settings:stop_streaming
A 1 mode at power-on | the saved mode is entered | drivers.imu61x.uart.settings:wake
A 1.1 rates | 115200 bit/s to 1.5 Mbit/s | drivers.imu61x.uart.commands:BAUD_RATES
A 1.1 default rate | 115200 bit/s | drivers.imu61x.uart.settings:FACTORY_BAUD
A 1.1 characters | 8 data bits, 1 stop bit, no parity | links.uart:UartLink
A 1.2 headers | AA 55 from the device, 55 AA from the host | drivers.imu61x.uart.codec:FrameFinder
A 1.2 ID and length | little-endian, length of the payload | drivers.imu61x.uart.codec:HEADER
A 1.2 CRC | 32 bits, low byte first, initial value 1 | drivers.imu61x.common:crc32
A 1.3 frame | ID 0x0002, 44 bytes | drivers.imu61x.uart.codec:AHRS_FRAME
A 1.3 timer | µs, 32 bits | drivers.imu61x.uart.codec:TIMER_MODULUS
A 1.3 pitch | degrees | drivers.imu61x.uart.codec:Imu61xCodec
A 1.3 roll | degrees | drivers.imu61x.uart.codec:Imu61xCodec
A 1.3 yaw | degrees | drivers.imu61x.uart.codec:Imu61xCodec
A 1.3 acceleration | g | drivers.imu61x.common:M_S2_PER_G
A 1.3 angular rate | °/s | drivers.imu61x.common:RAD_S_PER_DEG_S
A 1.3 temperature | °C | drivers.imu61x.uart.codec:Imu61xCodec
A 1.3 rate and line | at most 200 Hz at 115200 bit/s | drivers.imu61x.uart.commands:max_rate_hz
A 1.4 frame | ID 0x00FF, length by model | drivers.imu61x.uart.codec:STATUS_FRAME
A 1.4 software version | | drivers.imu61x.uart.codec:Status
A 1.4 hardware version | | drivers.imu61x.uart.codec:Status
A 1.4 serial number | three words | drivers.imu61x.uart.settings:identity_of
A 1.4 status members | state, load, voltage, calibration, health (ERRATA A3) | drivers.imu61x.uart.codec:Status
A 1.5 frame | ID 0x0006, 24 bytes | drivers.imu61x.uart.codec:PARAMETER_FRAME
A 1.5 parameter 3 | baud rate | drivers.imu61x.uart.codec:Parameter
A 1.5 parameters 8 to 10 | results of the gyroscope calibration | drivers.imu61x.uart.settings:GYRO_OFFSETS
A 1.5 parameters 16 to 18 | mounting error angles | drivers.imu61x.uart.settings:INSTALLATION_ANGLES
A 1.5 parameter 21 | output rate | drivers.imu61x.uart.codec:Parameter
A 1.5 parameter 27 | second bus | drivers.imu61x.uart.commands:BusMode
A 1.5 parameter 30 | I2C address | drivers.imu61x.uart.codec:Parameter
A 1.5 parameter 31 | filters | drivers.imu61x.uart.codec:Parameter
A 1.6 request | 55 AA, CMD as ID, 24 bytes | drivers.imu61x.uart.commands:encode_command
A 1.6 CMD 1 | status once | drivers.imu61x.uart.commands:ask_status
A 1.6 CMD 2 | AHRS data once | drivers.imu61x.uart.commands:ask_ahrs
A 1.6 CMD 3 stream | mode 1 | drivers.imu61x.uart.settings:start_streaming
A 1.6 CMD 3 command | mode 100 | drivers.imu61x.uart.settings:stop_streaming
A 1.6 CMD 4 | heading, 0 to 360° | drivers.imu61x.uart.commands:reset_heading
A 1.6 CMD 5 | save | drivers.imu61x.uart.settings:save
A 1.6 CMD 6 | read a parameter | drivers.imu61x.uart.commands:read_parameter
A 1.6 CMD 7 | start of the installation calibration | drivers.imu61x.uart.commands:start_installation_calibration
A 1.6 CMD 8 | its status | drivers.imu61x.uart.commands:ask_installation_status
A 1.6 CMD 9 | restart | drivers.imu61x.uart.settings:restart
A 1.6 CMD 10 | bias of the gyroscope | drivers.imu61x.uart.driver:calibrate_gyro
A 1.6 CMD 14, 3 | baud rate, five values | drivers.imu61x.uart.settings:change_baud
A 1.6 CMD 14, 21 | output rate: 1, 10, 50, 100, 200, 400 Hz | drivers.imu61x.uart.commands:RATES_HZ
A 1.6 CMD 14, 27 | second bus: four values | drivers.imu61x.uart.commands:set_bus_mode
A 1.6 CMD 14, 30 | I2C address: four values | drivers.imu61x.uart.commands:set_i2c_address
A 1.6 CMD 14, 31 | filters | drivers.imu61x.uart.commands:set_filter
A 1.6 other values | the device takes its default instead: refused before they are sent | drivers.imu61x.uart.settings:write_parameter
A 1.6 CMD 15 | factory settings | drivers.imu61x.uart.settings:factory_reset
A 1.7 K1 | acknowledgement: command and result (ERRATA A4, A22) | drivers.imu61x.uart.codec:Acknowledgement
A 1.8 two hosts | only one TX may be at the device's RX: without the transmit line imud listens | drivers.imu61x.uart.settings:identify
A 1.8 one program | the port has one user | links.uart:UartLink
A 2.1 role | the device is a slave | links.spi:SpiLink
A 2.1 clock | 0.2 to 2 MHz | links.spi:SpiOptions
A 2.1 words | 16 bits, high bit first | links.spi:SpiLink
A 2.1 mode | idle low, rising edge: 0 (ERRATA A6) | drivers.imu61x.spi:MODES
A 2.2 reset | reset the device and wait for 3 s | lines.reset:ResetLine
A 2.3 read and write | bit 15, address, data | drivers.imu61x.spi:write
A 2.3 answers | with the second word after the read | drivers.imu61x.spi:answers
A 2.4 BURST | 0x00, window 0 | drivers.imu61x.registers:BURST
A 2.4 BURST_CTRL | 0x0C and 0x0D, window 1 (ERRATA A20) | drivers.imu61x.registers:BURST_CTRL
A 2.4 FILTER_CTRL | 0x06 and 0x07, window 1 | drivers.imu61x.registers:FILTER_CTRL
A 2.4 PROD_ID | 0x6A to 0x70, window 1 | drivers.imu61x.registers:PROD_ID
A 2.4 WIN_CTRL | 0x7E, both windows | drivers.imu61x.registers:WIN_CTRL
A 2.4 single registers | temperature, gyroscope, accelerometer at 0x0E to 0x28 | drivers.imu61x.spi:READ_REGISTERS
A 2.4.1 reading | 0x8000, then zeros, chip select held | drivers.imu61x.spi:READ_STANDARD
A 2.4.1 order | gyroscope, accelerometer, checksum; low word first | drivers.imu61x.spi:Imu61xSpiCodec
A 2.4.1 checksum | sum of all words before (ERRATA A9) | drivers.imu61x.spi:Imu61xSpiCodec
A 2.4.1 extended burst | table 18 (ERRATA A10) | drivers.imu61x.spi:EXTENDED
A 2.4.1 scale of the gyroscope | 0.016 / 65536 °/s | drivers.imu61x.registers:RAD_S_PER_COUNT
A 2.4.1 scale of the accelerometer | burst 0.2 / 65536 g, registers 0.2 / 1000 / 65536 g (ERRATA A11) | drivers.imu61x.registers:M_S2_PER_COUNT_REGISTER
A 2.4.1 scale of the temperature | −1 / 263.4 °C, zero at 172621824 | drivers.imu61x.registers:temperature_c
A 2.4.1 scale of the attitude | 0.00699411 / 65536 ° | left: no register and no frame of the manual carries the attitude as counts
A 2.4.2 layout | accelerometer in the high half byte, gyroscope in the low one | drivers.imu61x.common:filter_control
A 2.4.2 codes | sixteen filters of table 21 | drivers.imu61x.common:FILTERS
A 2.4.2 write and read | 0x86XX, 0x0600 | drivers.imu61x.spi:set_up
A 2.4.2 default | 0xBB, 47 Hz | drivers.imu61x.common:FILTER_DEFAULT
A 2.4.3 products | IMU612, 614, 618, 6132A, 6132B | drivers.imu61x.common:PRODUCTS
A 2.4.3 reading | 0x6A00 to 0x7000 | drivers.imu61x.spi:READ_STATE
A 2.4.4 windows | 0xFE01 opens window 1, 0 is for data | drivers.imu61x.spi:OPEN
A 3.1 rate | 400 kHz | links.i2c:I2cLink
A 3.1 address | 0x18, 7 bits | drivers.imu61x.common:I2C_ADDRESSES
A 3.2 pull-ups | 4.7 kΩ | left: wiring; in README.md and docs/buses.md
A 3.3.1 reading | register 0x12, 32 bytes, one transaction (ERRATA A13) | drivers.imu61x.i2c:READ_BURST
A 3.3.1 order | accelerometer in g, gyroscope in °/s, temperature in °C | drivers.imu61x.i2c:FRAME
A 3.3.1 CRC | over the first 28 bytes | drivers.imu61x.i2c:CRC_OFFSET
A 3.3.2 filters | register 0x06, read and written | drivers.imu61x.i2c:write_filter
A 3.3.3 ID | register 0x6A, 8 bytes | drivers.imu61x.i2c:READ_ID
A 4.1 frames | standard frames | drivers.imu61x.can:Imu61xCanCodec
A 4.1 rate | 250 kbit/s to 1 Mbit/s | links.socketcan:SocketCanLink
A 4.2 frame 101 | roll, pitch | drivers.imu61x.can:SET
A 4.2 frame 102 | yaw, angular rate X | drivers.imu61x.can:SET
A 4.2 frame 103 | angular rate Y, Z | drivers.imu61x.can:SET
A 4.2 frame 104 | acceleration X, Y | drivers.imu61x.can:SET
A 4.2 frame 105 | acceleration Z, temperature, index | drivers.imu61x.can:SET
A 4.2 temperature | 0.01 °C (ERRATA A17) | drivers.imu61x.can:C_PER_COUNT
A 5 CRC-32 | by table | drivers.imu61x.common:crc32
B 1.1 9-axis mode | only after a calibration, and where the field is undisturbed | drivers.hipnuc.uart.driver:CALIBRATIONS
B 1.2.1 trigger | a frame for each rising edge on SIN | lines.trigger:SinTrigger
B 1.2.1 delay of the answer | 125 µs on average | sampling.clock:SampleClock
B 1.2.1 UTC by PPS and RMC | time stamps become UTC in ms | sampling.device_utc:DeviceUtc
B 1.2.1 pulse per second | 1 s, rising edge, on the second | sampling.device_utc:PpsAge
B 1.2.1 RMC sentences | 1 to 10 Hz, at the rate of the line | formats.nmea0183:as_gprmc
B 1.2.2 SOUT | a high pulse before each frame | sampling.edge_pairing:EdgePairing
B 1.2.2 timed output off | UNLOGALL before ONMARK | drivers.hipnuc.uart.commands:unlog_all
B 2 line end | CR LF | drivers.hipnuc.uart.commands:LINE_END
B 2.2.1 REBOOT | as by power-on | drivers.hipnuc.uart.commands:reboot
B 2.2.2 SAVECONFIG | all settings to flash | drivers.hipnuc.uart.commands:save_config
B 2.2.3 SERIALCONFIG | five rates | drivers.hipnuc.uart.commands:serial_config
B 2.2.3 a wrong rate | the connection is cut; imud follows the device | drivers.hipnuc.uart.commands:change_baud
B 2.2.4 when CONFIG acts | at once; kept by SAVECONFIG | drivers.hipnuc.uart.settings:SETTINGS
B 2.2.4 ATT MODE 0 | six axes | drivers.hipnuc.uart.commands:attitude_mode
B 2.2.4 ATT MODE 1 | nine axes | drivers.hipnuc.uart.commands:attitude_mode
B 2.2.4 ATT RST 2 | relative level | drivers.hipnuc.uart.commands:level_reset
B 2.2.4 ATT RST 3 | automatic level, the accelerometer too | drivers.hipnuc.uart.commands:level_reset
B 2.2.4 ATT RST 5 | cancels the level | drivers.hipnuc.uart.commands:level_reset
B 2.2.4 rest | ATT RST at rest only | device.calibration:CalibrationRun
B 2.2.4 YAW 1 | absolute heading | drivers.hipnuc.uart.commands:yaw
B 2.2.4 YAW 0 | relative heading | drivers.hipnuc.uart.commands:yaw
B 2.2.4 YAW range | ±180°, lost at power-off | drivers.hipnuc.uart.driver:VERBS
B 2.2.4 URFR | a rotation, in force after a restart | drivers.hipnuc.uart.commands:mounting
B 2.2.4 URFR presets | nine mountings (ERRATA B30) | drivers.hipnuc.uart.commands:Mounting
B 2.2.4 PMUX | functions of IO1 to IO9 | drivers.hipnuc.uart.commands:pin_function
B 2.2.4 PMUX1 SIN | IO1 | drivers.hipnuc.uart.commands:PinFunction
B 2.2.4 PMUX2 SOUT | IO2, 80 µs | drivers.hipnuc.uart.commands:PinFunction
B 2.2.4 PMUX3 LED | IO5 | drivers.hipnuc.uart.commands:PinFunction
B 2.2.4 PMUX4 SOUT_DIV | IO6, divided by 8 | drivers.hipnuc.uart.commands:PinFunction
B 2.2.4 PMUX5 ALARM | IO9 | drivers.hipnuc.uart.commands:PinFunction
B 2.2.4 pins by firmware | 1.5.5 and newer | sim.hipnuc.uart_settings:changed
B 2.2.4 alarm range | axis, minimum, maximum, enabled | drivers.hipnuc.uart.commands:alarm
B 2.2.4 alarm level | high outside of the range | lines.alarm:AlarmLine
B 2.2.4 divider | 1 to 64 | drivers.hipnuc.uart.commands:sout_divider
B 2.2.5 LOG ENABLE | frames out | drivers.hipnuc.uart.commands:log_enable
B 2.2.5 LOG DISABLE | no frames | drivers.hipnuc.uart.commands:log_disable
B 2.2.5 VERSION | product, serial number, firmware | drivers.hipnuc.uart.replies:parse_version
B 2.2.5 USRCONFIG | settings of the user | drivers.hipnuc.uart.settings:report_values
B 2.2.5 COMCONFIG | port and outputs | drivers.hipnuc.uart.replies:parse_comconfig
B 2.2.5 ONTIME | periods of 1 s to 2 ms, and so on | drivers.hipnuc.uart.commands:log_ontime
B 2.2.5 output off | period 0 | drivers.hipnuc.uart.commands:log_ontime
B 2.2.5 names | IMU91 is HI91 | drivers.hipnuc.uart.commands:OutputMessage
B 2.2.5 output and line | a high rate needs a high baud rate | drivers.hipnuc.uart.commands:require_room
B 2.2.5 ONMARK 1 | a frame per pulse | drivers.hipnuc.uart.commands:log_onmark
B 2.2.5 ONMARK ONCE | a frame by command | drivers.hipnuc.uart.commands:send_once
B 2.2.6 UNLOGALL | all timed output off | drivers.hipnuc.uart.commands:unlog_all
B 2.2.7 FRESET | factory settings | drivers.hipnuc.uart.commands:reset_to_factory
B 3 characters | 8N1 | links.uart:UartLink
B 3.1 header | 5A A5 | drivers.hipnuc.uart.codec:SYNC
B 3.1 length | 1 to 512 | drivers.hipnuc.uart.codec:PAYLOAD_BYTES_MAX
B 3.1 sub-packets | several in one frame, each with its tag | drivers.hipnuc.uart.codec:PACKETS
B 3.2 factory output | HI91 at 100 Hz | sim.hipnuc.uart_settings:ModuleSettings
B 3.3.1 size | 76 bytes, tag 0x91 | drivers.hipnuc.uart.codec:HI91
B 3.3.1 pps_sync_stamp | ms since the last pulse, wraps at 8192 | drivers.hipnuc.uart.codec:PPS_STAMP_MODULUS_MS
B 3.3.1 temperature | °C | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.1 air_pressure | Pa (ERRATA B35) | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.1 system_time | ms since power-on | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.1 acceleration | G | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.1 angular rate | °/s | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.1 magnetic field | µT | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.1 angles | roll, pitch, yaw in degrees | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.1 quaternion | W, X, Y, Z | drivers.hipnuc.uart.codec:_decode_hi91
B 3.3.2 size | 48 bytes, tag 0x92 | drivers.hipnuc.uart.codec:HI92
B 3.3.2 status | | drivers.hipnuc.uart.codec:HI92
B 3.3.2 temperature | °C | drivers.hipnuc.uart.codec:HI92
B 3.3.2 pps_sync_stamp | ms since the last pulse (ERRATA B33) | drivers.hipnuc.uart.codec:HI92
B 3.3.2 air_pressure | Pa, less 100000 | drivers.hipnuc.uart.codec:PRESSURE_OFFSET_PA
B 3.3.2 angular rate | 0.001 rad/s | drivers.hipnuc.uart.codec:GYRO_RAD_S_PER_LSB
B 3.3.2 acceleration | 0.0048828 m/s² | drivers.hipnuc.uart.codec:ACCEL_M_S2_PER_LSB
B 3.3.2 magnetic field | 0.030517 µT | drivers.hipnuc.uart.codec:HI92
B 3.3.2 angles | 0.001° | drivers.hipnuc.uart.codec:HI92
B 3.3.2 quaternion | 0.0001 | drivers.hipnuc.uart.codec:HI92
B 3.4 CRC | CRC-16, polynomial 0x1021, from 0 | drivers.hipnuc.uart.codec:encode_frame
B 3.5 example | the printed frame | drivers.hipnuc.uart.codec:HipnucCodec
B 3.6 check of an example | (ERRATA B1) | drivers.hipnuc.uart.codec:HipnucCodec
B 3.7 rates by baud rate | table | drivers.hipnuc.uart.commands:MAX_RATE_HZ
B 4 defaults | 115200 8N1, address 80 | drivers.hipnuc.modbus.registers:FACTORY_ID
B 4 byte order | registers high byte first | drivers.hipnuc.modbus.registers:READ
B 4.1.1 read | function 0x03 | drivers.hipnuc.modbus.registers:read_registers
B 4.1.2 write | function 0x06 | drivers.hipnuc.modbus.registers:write_register
B 4.1.3 CRC | CRC-16/MODBUS | formats.modbus:crc16_modbus
B 4.2 registers | addresses, types, scales of the whole table | drivers.hipnuc.modbus.registers:REGISTERS
B 4.2 acceleration | 0x34 to 0x36 | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.2 angular rate | 0x37 to 0x39 | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.2 magnetic field | 0x3A to 0x3C | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.2 angles | 0x3D to 0x42 | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.2 temperature and pressure | 0x43 to 0x45 | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.2 quaternion | 0x46 to 0x49 | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.2 inclinometer | 0x4A, 0x4B, one axis or two | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.2 identity | 0x70 to 0x82 | drivers.hipnuc.modbus.commands:identity_of
B 4.3.1 save | CTRL 0 | drivers.hipnuc.modbus.commands:save
B 4.3.1 factory settings | CTRL 1 | drivers.hipnuc.modbus.commands:factory_reset
B 4.3.1 restart | CTRL 0xFF | drivers.hipnuc.modbus.commands:restart
B 4.3.2 baud rate | nine codes (and 256000, ERRATA B34) | drivers.hipnuc.modbus.commands:set_baud
B 4.3.3 address | at once in force | drivers.hipnuc.modbus.commands:change_address
B 4.3.4 mounting | five values | drivers.hipnuc.modbus.commands:set_mounting
B 4.3.5 level | set and cancelled | drivers.hipnuc.modbus.commands:auto_level
B 4.3.6 axes | six or nine | drivers.hipnuc.modbus.commands:set_heading_mode
B 4.4 example | version of a module | drivers.hipnuc.modbus.commands:probe
B 4.5 example | sensors of a module | drivers.hipnuc.modbus.codec:HipnucModbusCodec
B 4.6 address by serial number | 0x50, 0x0031 | drivers.hipnuc.modbus.registers:set_id_by_serial
B 4.6 random addresses | 0x50, 0x0030 | drivers.hipnuc.modbus.registers:randomise_ids
B 5 frames | standard data frames | drivers.hipnuc.canopen.codec:HipnucCanopenCodec
B 5.1 defaults | 500 kbit/s, node 8, operational | drivers.hipnuc.canopen.cia301:NODE_DEFAULT
B 5.2 TPDO1 | acceleration, 0.001 G | drivers.hipnuc.canopen.codec:ACCEL_M_S2_PER_LSB
B 5.2 TPDO2 | angular rate, 0.1 °/s | drivers.hipnuc.canopen.codec:GYRO_RAD_S_PER_LSB
B 5.2 TPDO3 | angles, 0.01° | drivers.hipnuc.canopen.codec:EULER_RAD_PER_LSB
B 5.2 TPDO4 | quaternion, 0.0001 | drivers.hipnuc.canopen.codec:LAYOUTS
B 5.2 TPDO6 | pressure, Pa | drivers.hipnuc.canopen.codec:LAYOUTS
B 5.2 TPDO7 | inclinometer, 0.01° | drivers.hipnuc.canopen.codec:INCLI_RAD_PER_LSB
B 5.4.1 SDO | expedited write and its reply | drivers.hipnuc.canopen.cia301:write_object
B 5.4.1 node number | 0x20A0, 1 to 127, after a restart | drivers.hipnuc.canopen.commands:change_node
B 5.4.1 save | 0x2000, 0 | drivers.hipnuc.canopen.commands:save
B 5.4.1 restart | 0x2000, 0xFF | drivers.hipnuc.canopen.commands:restart
B 5.4.1 factory settings | 0x2000, 1, after power-on | drivers.hipnuc.canopen.commands:factory_reset
B 5.4.1 bit rate | 0x209A, four codes | drivers.hipnuc.canopen.commands:set_bit_rate
B 5.4.1 output rates | 0x1800 to 0x1805, sub-index 5 | drivers.hipnuc.canopen.commands:set_tpdo_period
B 5.4.1 signs of the inclinometer | 0x209E, 0x209F | drivers.hipnuc.canopen.commands:set_inclinometer_sign
B 5.4.1 zero of the inclinometer | 0x20A5, set and cancelled | drivers.hipnuc.canopen.commands:set_inclinometer_zero
B 5.4.2 transmission type | sub-index 2, by SYNC or timer | drivers.hipnuc.canopen.commands:set_tpdo_type
B 5.4.2 SYNC | identifier 0x80, no data | drivers.hipnuc.canopen.cia301:SYNC
B 6 identifiers | priority 3, PF 0xFF, address 8 | drivers.hipnuc.j1939.codec:FACTORY_ADDRESS
B 6.1.1 FF34 | acceleration | drivers.hipnuc.j1939.codec:ACCEL
B 6.1.2 FF37 | angular rate | drivers.hipnuc.j1939.codec:VECTOR
B 6.1.3 FF3D | roll and pitch | drivers.hipnuc.j1939.codec:TWO_ANGLES
B 6.1.4 FF41 | heading, clockwise | drivers.hipnuc.j1939.codec:HEADING_LAYOUT
B 6.1.5 FF4A | inclinometer | drivers.hipnuc.j1939.codec:TWO_ANGLES
B 6.2.1 request and reply | address, command, status, value (ERRATA B26, B28) | drivers.hipnuc.j1939.commands:exchange
B 6.2.2 intervals | five messages, 5 to 1000 ms | drivers.hipnuc.j1939.commands:set_interval
B 6.2.2 save | 0x0000, 0 | drivers.hipnuc.j1939.commands:save
B 6.2.2 factory settings | 0x0000, 1 | drivers.hipnuc.j1939.commands:factory_reset
B 6.2.2 restart | 0x0000, 0xFF | drivers.hipnuc.j1939.commands:restart
B 6.2.2 bit rate | 0x009A, five codes | drivers.hipnuc.j1939.commands:set_bitrate
B 6.2.2 address | 0x009C, 1 to 128 | drivers.hipnuc.j1939.commands:set_address
B 6.2.2 zero | 0x00A5, set and cancelled | drivers.hipnuc.j1939.commands:zero
B 6.2.2 directions | 0x009E, 0x009F | drivers.hipnuc.j1939.commands:set_direction
B 6.2.2 source address | any | drivers.hipnuc.j1939.codec:HOST_ADDRESS
B 7 NMEA 2000 | heading, rate of turn, attitude by the standard | drivers.hipnuc.nmea2000:measurement_of
B 8.1.1 procedure | steps and conditions | drivers.hipnuc.common:TURNING
B 8.1.1 result | bias of MAGCONFIG, zero before | drivers.hipnuc.uart.settings:report_values
B 8.1.2 disturbance | a field that does not turn with the module | device.turns:RESIDUAL_MAX
B 8.1.3 in the background | collects, calibrates, saves by itself | sim.hipnuc.uart_settings:SelfCalibration
B 8.2 EN_MCAL | in the background or not | drivers.hipnuc.uart.commands:magnetic_calibration
B 8.2 once | calibrate, then off and saved | drivers.hipnuc.uart.driver:CALIBRATIONS
B 8.3 indoors | nine axes may be worse than six | left: said in the instructions of the calibration and in docs/calibration.md
B 9.1 angles of a quaternion | order 312, ENU | attitude.rotation:euler312_from_quat
B 9.2 matrix of a quaternion | | attitude.rotation:matrix_from_quat
"""
ITEMS: Final = [item_of(row) for row in _ROWS.splitlines()]
