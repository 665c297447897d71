// SPDX-License-Identifier: GPL-2.0
/* An i2c_adapter whose other end is the simulator: plain I2C, SMBus emulated by the core. */
#include <linux/i2c.h>
#include <linux/list.h>
#include <linux/mm.h>
#include <linux/module.h>
#include <linux/slab.h>

#include "bus.h"

struct lab_i2c {
	struct i2c_adapter adapter;
	struct lab_bus *bus;
	struct list_head node;
};

static LIST_HEAD(buses);

static bool host_reads(const struct i2c_msg *message)
{
	return message->flags & I2C_M_RD;
}

static size_t request_size(const struct i2c_msg *messages, int count)
{
	size_t size = sizeof(struct lab_request) + count * sizeof(struct lab_i2c_segment);

	for (int i = 0; i < count; i++)
		size += host_reads(&messages[i]) ? 0 : messages[i].len;
	return size;
}

static struct lab_request *pack(const struct i2c_msg *messages, int count)
{
	size_t size = request_size(messages, count);
	struct lab_request *request;
	u8 *to;

	if (size > LAB_MAX_BYTES)
		return ERR_PTR(-EMSGSIZE);
	request = kvzalloc(size, GFP_KERNEL);
	if (!request)
		return ERR_PTR(-ENOMEM);
	request->size = size;
	request->kind = LAB_KIND_I2C;
	request->segments = count;
	to = (u8 *)(request + 1);
	for (int i = 0; i < count; i++) {
		const struct i2c_msg *message = &messages[i];
		struct lab_i2c_segment segment = {
			.address = message->addr,
			.flags = message->flags,
			.length = message->len,
		};

		memcpy(to, &segment, sizeof(segment));
		to += sizeof(segment);
		if (!host_reads(message)) {
			memcpy(to, message->buf, message->len);
			to += message->len;
		}
	}
	return request;
}

static void unpack(const struct lab_answer *answer, struct i2c_msg *messages, int count)
{
	const u8 *from = lab_answer_data(answer);

	for (int i = 0; i < count; i++)
		if (host_reads(&messages[i]))
			from = lab_answer_take(answer, from, messages[i].buf, messages[i].len);
}

static int lab_i2c_xfer(struct i2c_adapter *adapter, struct i2c_msg *messages, int count)
{
	struct lab_i2c *i2c = i2c_get_adapdata(adapter);
	struct lab_request *request = pack(messages, count);
	struct lab_answer *answer;
	u32 read_bytes = 0;
	int result;

	if (IS_ERR(request))
		return PTR_ERR(request);
	for (int i = 0; i < count; i++)
		read_bytes += host_reads(&messages[i]) ? messages[i].len : 0;
	answer = lab_bus_exchange(i2c->bus, request, count, read_bytes);
	kvfree(request);
	if (IS_ERR(answer))
		return PTR_ERR(answer);
	unpack(answer, messages, count);
	result = answer->status ? answer->status : answer->done;
	kvfree(answer);
	return result;
}

static u32 lab_i2c_functionality(struct i2c_adapter *adapter)
{
	return I2C_FUNC_I2C | I2C_FUNC_SMBUS_EMUL;
}

static const struct i2c_algorithm lab_i2c_algorithm = {
	.xfer = lab_i2c_xfer,
	.functionality = lab_i2c_functionality,
};

int lab_i2c_create(struct device *parent, int number)
{
	struct lab_i2c *i2c = kzalloc(sizeof(*i2c), GFP_KERNEL);
	int result;

	if (!i2c)
		return -ENOMEM;
	i2c->bus = lab_bus_create(parent, "i2c", number);
	if (IS_ERR(i2c->bus)) {
		result = PTR_ERR(i2c->bus);
		goto no_bus;
	}
	i2c->adapter.owner = THIS_MODULE;
	i2c->adapter.algo = &lab_i2c_algorithm;
	i2c->adapter.dev.parent = parent;
	i2c->adapter.nr = number;
	snprintf(i2c->adapter.name, sizeof(i2c->adapter.name), "imud lab i2c %d", number);
	i2c_set_adapdata(&i2c->adapter, i2c);
	result = i2c_add_numbered_adapter(&i2c->adapter);
	if (result)
		goto no_adapter;
	list_add(&i2c->node, &buses);
	return 0;

no_adapter:
	lab_bus_destroy(i2c->bus);
no_bus:
	kfree(i2c);
	return result;
}

void lab_i2c_destroy_all(void)
{
	struct lab_i2c *i2c, *next;

	list_for_each_entry_safe(i2c, next, &buses, node) {
		i2c_del_adapter(&i2c->adapter);
		lab_bus_destroy(i2c->bus);
		kfree(i2c);
	}
}
