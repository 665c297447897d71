/* SPDX-License-Identifier: GPL-2.0 */
/*
 * What a simulator reads from and writes to /dev/imud-lab-i2c<n> and
 * /dev/imud-lab-spi<n>. All fields are native-endian.
 *
 * One read() returns one whole request: the header, then for each segment its
 * description and, if the host sends data in it, the data. One write() is one
 * whole answer: the header, then the data of all segments the host reads, in
 * order, without gaps. tests/lab/wire.py has the same layouts.
 *
 * read():  EMSGSIZE  the buffer is smaller than the request, which stays
 * write(): ESTALE    no transfer waits for this id (answered, or timed out)
 *          EINVAL    size, status or done do not fit the transfer
 * open():  EBUSY     another simulator has the bus
 * poll() reports a waiting request as POLLIN. With nobody attached, every
 * transfer fails with ENXIO, as if no device were on the bus.
 */
#ifndef IMUD_LAB_PROTOCOL_H
#define IMUD_LAB_PROTOCOL_H

#include <linux/types.h>

#define LAB_KIND_I2C 1
#define LAB_KIND_SPI 2
#define LAB_MAX_BYTES (64 * 1024) /* of a request or an answer */

struct lab_request {
	__u32 id;          /* the answer repeats it */
	__u32 size;        /* bytes, this header included */
	__u16 kind;        /* LAB_KIND_* */
	__u16 segments;    /* I2C messages or SPI transfers */
	__u32 mode;        /* SPI mode bits of <linux/spi/spi.h>; 0 for I2C */
	__u32 chip_select; /* 0 for I2C */
};

struct lab_i2c_segment {
	__u16 address;
	__u16 flags;       /* I2C_M_* of <linux/i2c.h>; I2C_M_RD = the host reads */
	__u32 length;      /* bytes; they follow unless I2C_M_RD */
};

struct lab_spi_segment {
	__u32 length;             /* bytes; they follow if has_tx */
	__u32 speed_hz;
	__u32 delay_ns;           /* after the transfer, before the CS change */
	__u32 word_delay_ns;      /* between words */
	__u32 cs_change_delay_ns; /* chip select stays inactive for this long */
	__u8 bits_per_word;       /* 9..16: words are native-endian pairs of bytes */
	__u8 cs_change;
	__u8 has_tx;
	__u8 has_rx;
};

struct lab_answer {
	__u32 id;
	__s32 status;      /* 0, or a negative errno for the host */
	__u32 done;        /* I2C: segments done; SPI: bytes done. Fewer = short */
	__u32 size;        /* bytes that follow this header */
};

#endif
