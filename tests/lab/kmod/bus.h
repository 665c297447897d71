/* SPDX-License-Identifier: GPL-2.0 */
#ifndef IMUD_LAB_BUS_H
#define IMUD_LAB_BUS_H

#include <linux/device.h>
#include "protocol.h"

struct lab_bus;

/* Creates /dev/imud-lab-<kind><number>; an ERR_PTR() on failure. */
struct lab_bus *lab_bus_create(struct device *parent, const char *kind, int number);
void lab_bus_destroy(struct lab_bus *bus);

/*
 * Hands @request to the simulator and waits for its answer. @done_max is the
 * largest value of lab_answer.done, @read_bytes the data the host expects. A
 * successful answer (status 0, all done) carries exactly @read_bytes, any other
 * no more. Returns the answer, which the caller frees with kvfree(), or ERR_PTR():
 *   ENXIO      nobody is attached, or the simulator left
 *   ETIMEDOUT  no answer within the module parameter timeout_ms
 *   EINTR      the waiting process was killed
 * May sleep. Any number of callers; they are served one at a time.
 */
struct lab_answer *lab_bus_exchange(struct lab_bus *bus, struct lab_request *request,
				    u32 done_max, u32 read_bytes);

/* The data behind an answer's header. */
static inline const u8 *lab_answer_data(const struct lab_answer *answer)
{
	return (const u8 *)(answer + 1);
}

/* Copies the next @length bytes of an answer to @to; what is missing stays. */
static inline const u8 *lab_answer_take(const struct lab_answer *answer, const u8 *from,
					void *to, u32 length)
{
	const u8 *end = lab_answer_data(answer) + answer->size;
	u32 left = min_t(u32, length, end - from);

	memcpy(to, from, left);
	return from + left;
}

int lab_i2c_create(struct device *parent, int number);
void lab_i2c_destroy_all(void);
int lab_spi_create(struct device *parent, int number, unsigned int word_bits);
void lab_spi_destroy_all(void);

#endif
